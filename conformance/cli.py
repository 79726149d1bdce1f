"""`bilprov conform` and `bilprov simulate`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import rich_click as click
from rich.console import Console

from analyzer.confirm import confirm_motion
from analyzer.grammar_file import load_protocol
from analyzer.options import line_options, line_settings, note, timeout_in_ns
from analyzer.port import Port
from analyzer.ports import open_port
from analyzer.recording import session_metadata
from analyzer.serve import serve
from analyzer.session import Session
from analyzer.stopping import Stopper
from captures.errors import CaptureError
from conformance.api import (
    Options,
    conform_port,
    estimated_seconds,
    select_cases,
)
from conformance.api import conform as conform_device
from conformance.faults import fault_bank
from conformance.opening import opening_cases
from conformance.probes import Probe, open_probe
from conformance.progress import Progress
from conformance.recording import RunRecorder
from conformance.report import Report, as_json
from conformance.simulator import CONFORMING, Fault, Simulator
from conformance.summary import show
from spec.protocol import Protocol

SIM = "sim"
Command = TypeVar("Command", bound=Callable[..., Any])


def _milliseconds(name: str, text: str) -> Callable[[Command], Command]:
    kind = click.FloatRange(0, 60_000, min_open=True)
    return click.option(name, metavar="MS", type=kind, help=text)


@click.command()
@click.argument("target", metavar="PORT|sim")
@click.option("--probe", help="What sees a stop: tcp:HOST:PORT, exec:COMMAND, modem:LINE, ask.")
@click.option("--power", metavar="exec:COMMAND", help="A command that switches it off and on.")
@click.option("--only", multiple=True, metavar="GLOB", help="Only these cases; * crosses /.")
@click.option("--list", "listing", is_flag=True, help="List the cases and send nothing.")
@click.option("--fail-fast", is_flag=True, help="End after the first failure.")
@click.option("--seed", type=int, default=1, show_default=True, help="How data and motions rotate.")
@click.option("--strict", is_flag=True, help="Count non-strict as failed.")
@_milliseconds("--deadline", "How soon an answer is due.")
@_milliseconds("--silence", "How long the line is listened to after an answer.")
@_milliseconds("--truncation-timeout", "The pause that ends a frame; measured unless given.")
@click.option(
    "--json", "json_path", metavar="FILE", help="The report as JSON; - is standard output."
)
@click.option("--record", metavar="FILE.mcap", help="Record the run into a new capture.")
@click.option("--fault", metavar="NAME", help="With sim: misbehave in this way.")
@line_options
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@click.option("-v", "--verbose", is_flag=True, help="List every case that did not pass.")
@click.pass_obj
def conform(
    grammar: str | None,
    target: str,
    probe: str | None,
    power: str | None,
    only: tuple[str, ...],
    listing: bool,
    fail_fast: bool,
    seed: int,
    strict: bool,
    deadline: float | None,
    silence: float | None,
    truncation_timeout: float | None,
    json_path: str | None,
    record: str | None,
    fault: str | None,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    yes: bool,
    verbose: bool,
) -> int:
    """Test a device against the document: its answers, its safety stop, its state.

    PORT is a path or a pyserial URL of a device that will move; sim is the built-in simulator, in
    virtual time. Exit code: 0 conforms, 1 does not, 2 the port or the probe cannot be used, 3
    nothing failed but something could not be judged.
    """
    protocol = load_protocol(grammar)
    options = Options(only, seed, strict, fail_fast, deadline, silence, truncation_timeout)
    virtual = target == SIM
    try:
        cases = select_cases(protocol, options, every_cut=virtual)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    if listing:
        for case in (*opening_cases(protocol), *cases):
            click.echo(f"{case.id:28} {case.clause:20} {case.requirement}")
        return 0
    if virtual and probe not in (None, SIM):
        raise click.UsageError(f"the target sim brings its own probe; --probe {probe} is for ports")
    if not virtual and fault:
        raise click.UsageError("--fault is for the target sim; start `bilprov simulate --fault`")
    if power is not None and (virtual or not power.startswith("exec:")):
        raise click.UsageError(f"--power {power}: it takes exec:COMMAND, and is for ports")
    _require_writable(json_path)
    job = _Job(protocol, options, record, power and power.removeprefix("exec:"))
    with ExitStack() as stack:
        if virtual:
            device = Simulator(protocol, _named_fault(protocol, fault))
            report = job.on_simulator(stack, device, len(cases))
        else:
            settings = line_settings(protocol, baud, parity, stopbits)
            port = stack.enter_context(open_port(target, settings))
            seconds = estimated_seconds(protocol, cases, options)
            probe = "none" if probe is None else probe
            eye = open_probe(probe, port)
            if eye:
                stack.callback(eye.close)
            what = f"the robot at {target} will drive and turn for about {seconds:.0f} s"
            confirm_motion(what, yes=yes)
            note(f"{len(cases)} cases, about {seconds:.0f} s")
            report = job.on_port(stack, port, eye, probe, len(cases))
    _deliver(report, json_path, verbose=verbose)
    return report.exit


class _Job:
    """One run as the command line asks for it, with its progress bar and its recording."""

    def __init__(
        self, protocol: Protocol, options: Options, record: str | None, power: str | None
    ) -> None:
        self._power = power
        self._protocol = protocol
        self._options = options
        self._record = record
        self._tap: RunRecorder | None = None

    @property
    def broken(self) -> CaptureError | None:
        """Why the recording ended before the run did, None if it did not."""
        return self._tap.broken if self._tap else None

    def on_simulator(self, stack: ExitStack, device: Simulator, count: int) -> Report:
        """Run in virtual time."""
        stopper = stack.enter_context(Stopper())
        line = line_settings(self._protocol, None, None, None)
        tap = self._recorder(stack, SIM, str(line))
        return conform_device(
            device,
            grammar=self._protocol,
            options=self._options,
            watcher=stack.enter_context(Progress(count, tap)),
            tap=tap,
            interrupted=lambda: stopper.stopped or str(self.broken or ""),
            fault=None if device.fault is CONFORMING else device.fault.name,
        )

    def on_port(
        self,
        stack: ExitStack,
        port: Port,
        probe: Probe | None,
        probe_name: str,
        count: int,
    ) -> Report:
        """Run in real time; the robot moves."""
        stopper = stack.enter_context(Stopper())
        tap = self._recorder(stack, port.name, str(port.settings))
        return conform_port(
            port,
            probe,
            probe_name,
            grammar=self._protocol,
            options=self._options,
            stop=stopper.fileno(),
            interrupted=lambda: stopper.stopped or str(self.broken or ""),
            watcher=stack.enter_context(Progress(count, tap, shown=probe_name != "ask")),
            tap=tap,
            power=self._power,
        )

    def _recorder(self, stack: ExitStack, device: str, line: str) -> RunRecorder | None:
        if self._record is None:
            return None
        timeout = timeout_in_ns(self._protocol, self._options.truncation_timeout)
        metadata = session_metadata(
            self._protocol,
            ports={"device": device},
            line=line,
            timeout=timeout,
            skew=0,
            heard=("host", "device"),
        )
        session = Session(self._protocol, timeout=timeout, skew=0)
        recorder = RunRecorder(self._record, session, time.time_ns(), metadata)
        self._tap = stack.enter_context(recorder)
        return self._tap


def _require_writable(path: str | None) -> None:
    """A report that cannot be written is better known before the robot moves."""
    if path in (None, "-"):
        return
    file = Path(str(path))
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise click.UsageError(
            f"--json {path} cannot be written: name a file in a folder that exists"
        )


def _named_fault(protocol: Protocol, name: str | None) -> Fault | None:
    if name is None:
        return None
    bank = fault_bank(protocol)
    if name not in bank:
        near = [known for known in bank if name.split("-")[0] in known][:3]
        hint = f", perhaps {', '.join(near)}" if near else ""
        raise click.UsageError(f"there is no fault {name!r}{hint}; see simulate --list-faults")
    return bank[name]


def _deliver(report: Report, json_path: str | None, *, verbose: bool) -> None:
    console = Console(stderr=json_path == "-", highlight=False, soft_wrap=True)
    show(report, console, everything=verbose)
    if json_path == "-":
        sys.stdout.write(as_json(report).decode())
    elif json_path is not None:
        Path(json_path).write_bytes(as_json(report))


@click.command()
@click.option("--listen", metavar="HOST:PORT", help="Serve raw TCP instead of a pty; port 0: any.")
@click.option("--probe-listen", metavar="HOST:PORT", help="Serve the probe over TCP too.")
@click.option("--fault", metavar="NAME", help="Misbehave in one named way.")
@click.option("--list-faults", is_flag=True, help="List the named faults.")
@click.pass_obj
def simulate(
    grammar: str | None,
    listen: str | None,
    probe_listen: str | None,
    fault: str | None,
    list_faults: bool,
) -> int:
    """Serve the reference device on a pty, or over TCP, until Ctrl-C.

    Prints one line for each thing it serves: the pty's path, socket://HOST:PORT, and
    probe tcp:HOST:PORT, which are what sniff, conform and --probe take.
    """
    protocol = load_protocol(grammar)
    if list_faults:
        for known in fault_bank(protocol).values():
            click.echo(f"{known.name:32} {known.family:8} {known.doc}")
        return 0
    device = Simulator(protocol, _named_fault(protocol, fault))
    with Stopper() as stopper:
        try:
            serve(
                device,
                pty=listen is None,
                listen=listen,
                probe_listen=probe_listen,
                announce=lambda line: click.echo(line),
                stop=stopper,
            )
        except ValueError as error:
            raise click.UsageError(str(error)) from error
    return 0
