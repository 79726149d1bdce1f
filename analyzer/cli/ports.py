"""`bilprov ports`: lists ports, and finds what keeps one from being used, and what fixes it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from bilprov.analyzer.cli.command import argument, command, group, option, protocol_in_use
from bilprov.analyzer.cli.options import LINE, Finite, LineOptions, refused, text_format_option
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.output.console import heading, show, show_json, table
from bilprov.captures.text import escape_controls, printable

if TYPE_CHECKING:
    from rich.console import RenderableType

    from bilprov.analyzer.doctor.finding import Finding
    from bilprov.analyzer.transport.machine import PortInfo


class PortsOptions(msgspec.Struct, frozen=True):
    """The options of `ports`."""

    names: tuple[str, ...] = argument(metavar="[PORT]...", nargs=-1, type=PortName())
    seconds: float = option(type=Finite(0), default=2.0, help="How long to listen at a port.")
    line: LineOptions = group(LineOptions)
    style: str = text_format_option()


@command(PortsOptions, only_with={"names": ("seconds", *LINE)})
def ports(options: PortsOptions) -> int:
    """Examples:
      bilprov ports
      bilprov ports /dev/ttyUSB0
      bilprov ports /dev/ttyUSB0 /dev/ttyUSB1

    The list has each port's adapter and who holds it; programs of other users only sudo shows. USB
    adapters and boards are marked with a star. The latency is how long an adapter holds bytes back.

    A PORT is a path or a pyserial URL. For each, the command reports what keeps it from being used,
    and prints the one command that fixes it. Two PORTs are two taps, the host's and the device's:
    the command reports whether they are swapped. Nothing is sent; opening raises DTR, which resets
    an Arduino. A port that another program holds is not opened.

    Exit code: 0 the list is shown, or the port can be used as it is, with or without advice; 2 it
    cannot; 130 Ctrl-C.
    """
    names, as_json = options.names, options.style == "json"
    if not names:
        from bilprov.analyzer.transport.machine import list_ports

        listed = list_ports()
        if as_json:
            show_json([asdict(port) for port in listed])
        else:
            show(*drawn(listed))
        return 0
    from bilprov.analyzer.doctor.examination import of_line, of_system
    from bilprov.analyzer.doctor.finding import usable
    from bilprov.analyzer.taps.sources import require_two_lines
    from bilprov.analyzer.transport.signals import Stopper

    protocol = protocol_in_use()
    settings = options.line.settings(protocol)
    if len(names) > 2:
        raise click.UsageError("give one PORT, or two that are the host's tap and the device's")
    if len(names) > 1:
        with refused(click.UsageError):
            require_two_lines(*names)
    findings = Findings(as_json=as_json)
    for name in names:
        findings.show(name, of_system(name))
    if usable(findings.found):
        with Stopper() as stopper:
            heard = of_line(protocol, names, settings, options.seconds, stopper)
            findings.show("both taps" if len(names) > 1 else names[0], heard)
        if stopper.stopped:  # by a signal: no verdict was reached
            raise KeyboardInterrupt
    return findings.end(names)


_BY_ID = "/dev/serial/by-id"


def drawn(found: Sequence[PortInfo]) -> Iterator[RenderableType]:
    """Yield the tables: each port with its driver and holders, its device, its lasting name."""
    from rich.text import Text

    if not found:
        yield Text(
            "No serial port here. Plug the robot or its USB adapter in and try again, give the "
            "path of a pty or a URL like socket://HOST:PORT, or try without a robot: "
            "bilprov simulate"
        )
        return
    rows, devices, names = [], [], []
    for port in found:
        path = printable(port.path)
        late = "" if port.latency_ms is None else f"{port.latency_ms} ms"
        held = ", ".join(f"{holder.name} (pid {holder.pid})" for holder in port.holders)
        sign = "*" if port.likely else ""
        rows.append((sign, path, port.usb, printable(port.driver), late, held))
        serial = f"serial {port.serial_number}" if port.serial_number else ""
        devices.append((path, ", ".join(filter(None, (port.description, serial)))))
        names.append((path, Path(port.by_id).name))
    yield table(("", "port", "usb", "driver", "latency", "held by"), rows, right="latency")
    for column, told in (("device", devices), (f"name in {_BY_ID}, which stays", names)):
        known = [(path, printable(said)) for path, said in told if said]
        if known:
            yield Text()
            yield table(("port", column), known)


class Findings:
    """Shows findings as they come, or all of them as JSON at the end."""

    def __init__(self, *, as_json: bool) -> None:
        from bilprov.analyzer.doctor import finding

        self.found: list[Finding] = []
        self._doctor = finding
        self._told: list[dict[str, Any]] = []  # each of those found, with its section
        self._as_json = as_json
        self._section = ""

    def show(self, section: str, findings: Iterable[Finding]) -> None:
        """Take the findings of a port, or of what is heard on both, and show each at once."""
        if not self._as_json and section != self._section:
            self._section = section
            show(heading(self._doctor.title(section)))
        for finding in findings:
            self.found.append(finding)
            self._told.append({"about": section} | asdict(finding))
            if not self._as_json:
                show(self._doctor.drawn(finding))
                if finding.command:  # by itself: it must stay on one line to be copied
                    indent = " " * self._doctor.INDENT
                    click.secho(indent + escape_controls(finding.command), bold=True)
                sys.stdout.flush()  # listening takes its time

    def end(self, names: Sequence[str]) -> int:
        """Show whether the ports, or the files, can be used, and return the exit code."""
        code = 0 if self._doctor.usable(self.found) else 2
        if self._as_json:
            about = {"ports": list(names), "usable": not code, "exit": code}
            show_json(about | {"findings": self._told})
        else:
            show(self._doctor.conclusion(names, self.found))
        return code
