"""`bilprov doctor`: finds what keeps a port or a capture from being used, and what mends it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.options import (
    Finite,
    confirm_motion,
    line_options,
    note,
    note_suspension,
    text_format_option,
)
from bilprov.analyzer.output.console import show, show_json
from bilprov.captures.text import escape_controls

if TYPE_CHECKING:
    from bilprov.analyzer.doctor.finding import Finding
    from bilprov.spec.protocol import Protocol


@click.command()
@click.argument("port", metavar="PORT|FILE.mcap")
@click.argument("device", metavar="[DEVICE]", required=False)
@click.option(
    "--seconds",
    type=Finite(0),
    default=2.0,
    show_default=True,
    help="How long to listen.",
)
@click.option("--ask", is_flag=True, help="Send the link check at each common baud rate.")
@click.option("--yes", is_flag=True, help="With --ask: the robot may move, do not ask me.")
@line_options
@text_format_option
@click.pass_obj
def doctor(
    grammar: str | None,
    port: str,
    device: str | None,
    seconds: float,
    ask: bool,
    yes: bool,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    style: str,
) -> int:
    """Find what keeps a port from being used, and say the one command that mends it.

    PORT is a path or a pyserial URL. Of a capture file it is told what is damaged, where, and what
    is lost, in bytes and seconds. With DEVICE they are two taps, the host's and the device's,
    and it is told whether they are swapped. Nothing is sent; opening raises DTR, which resets an
    Arduino. A port that somebody holds is not opened.

    With --ask the link check is sent at each common baud rate, and the device that answers is
    homed. At a wrong rate it hears other bytes, and may drive.

    Exit code: 0 the port can be used as it is, with or without advice, or nothing of the capture is
    lost; 2 it cannot, or something is; 130 Ctrl-C.
    """
    from bilprov.analyzer.doctor.asking import longest_time, rates_of
    from bilprov.analyzer.doctor.examination import of_line, of_system
    from bilprov.analyzer.doctor.finding import usable
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.taps.sources import require_two_lines
    from bilprov.analyzer.transport.line_settings import line_settings
    from bilprov.analyzer.transport.signals import Stopper

    if _is_capture(port):
        return _capture(Path(port), device, ask=ask, as_json=style == "json")
    protocol = load_protocol(grammar)
    settings = line_settings(protocol, baud, parity, stopbits)
    names = [name for name in (port, device) if name is not None]
    _require_ports(names)
    if device is not None:
        if ask:
            raise click.UsageError(
                "--ask asks one device: give one PORT; taps are never written to"
            )
        try:
            require_two_lines(port, device)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    report = _Report(as_json=style == "json")
    for name in names:
        report.begin(name)
        report.tell(of_system(name))
    if usable(report.findings):
        rates = rates_of(port, settings.baud) if ask else ()
        if rates:
            what = _what_may_move(protocol, port, rates, longest_time(protocol, rates))
            confirm_motion(protocol, what, yes=yes)
            if yes:
                note(what)
        if device is not None:
            report.begin("both taps")
        with Stopper() as stopper:
            report.tell(of_line(protocol, names, settings, seconds, stopper, rates))
        note_suspension(stopper)
        if stopper.stopped:  # by a signal: no verdict was reached
            raise KeyboardInterrupt
    return report.end(names)


def _is_capture(name: str) -> bool:
    """Whether a name is a capture's: a character device, a URL or nothing at all is a port's."""
    from bilprov.captures.parts import kept_parts

    path = Path(name)
    if "://" in name:
        return False
    if not path.exists():
        return path.suffix == ".mcap" or bool(kept_parts(path))
    return not path.is_char_device()


def _capture(path: Path, device: str | None, *, ask: bool, as_json: bool) -> int:
    """Examine a capture file; returns the exit code."""
    from bilprov.analyzer.doctor.capture_file import of_capture

    if device is not None or ask:
        raise click.UsageError(f"{path} is a capture: it is examined alone, and nothing is asked")
    report = _Report(as_json=as_json)
    report.begin(str(path))
    report.tell(of_capture(path))
    return report.end([str(path)])


def _what_may_move(protocol: Protocol, port: str, rates: Sequence[int], seconds: float) -> str:
    from bilprov.spec.by_effect import link_check
    from bilprov.spec.movement import all_movement, movement_of, movement_words

    first = f"the robot at {port} is asked at {rates[0]} baud"
    if len(rates) == 1:
        words = movement_words(protocol, movement_of(protocol, link_check(protocol)))
        return f"{first}: {words}"
    words = movement_words(protocol, all_movement(protocol))
    return (
        f"{first} and {len(rates) - 1} other rates, for up to {seconds:.0f} s; at a wrong rate it "
        f"hears other bytes than are sent, and may do anything: {words}"
    )


def _require_ports(names: Sequence[str]) -> None:
    from bilprov.analyzer.settings import SIM
    from bilprov.analyzer.transport.errors import missing
    from bilprov.analyzer.transport.machine import Machine

    for name in names:
        if name == SIM and not Path(name).exists():
            raise missing(name, (), Machine())
        if Path(name).is_file():
            raise click.UsageError(
                f"{name} is a file and no port; what a capture holds tells: bilprov info {name}"
            )


class _Report:
    """Tells findings as they come, or all of them as JSON at the end."""

    def __init__(self, *, as_json: bool) -> None:
        self.findings: list[Finding] = []
        self._ports: list[str] = []
        self._as_json = as_json
        self._section = ""

    def begin(self, section: str) -> None:
        """Begin the findings of a port, or of what is heard on both."""
        self._section = section
        if not self._as_json:
            from bilprov.analyzer.doctor.drawing import heading, title

            show(heading(title(section)))

    def tell(self, findings: Iterable[Finding]) -> None:
        """Take findings, and show each at once."""
        for finding in findings:
            self.findings.append(finding)
            self._ports.append(self._section)
            if not self._as_json:
                from bilprov.analyzer.doctor.drawing import INDENT, drawn

                show(drawn(finding))
                if finding.command:  # by itself: it must stay on one line to be copied
                    click.secho(" " * INDENT + escape_controls(finding.command), bold=True)
                sys.stdout.flush()  # listening and asking take their time

    def end(self, names: Sequence[str]) -> int:
        """Tell whether the ports can be used, and return the exit code."""
        from bilprov.analyzer.doctor.finding import usable

        code = 0 if usable(self.findings) else 2
        if self._as_json:
            found = [
                {"about": section} | asdict(finding)
                for section, finding in zip(self._ports, self.findings, strict=True)
            ]
            show_json({"ports": list(names), "usable": not code, "exit": code, "findings": found})
        else:
            from bilprov.analyzer.doctor.drawing import conclusion

            show(conclusion(names, self.findings))
        return code
