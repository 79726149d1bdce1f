"""`bilprov conform`: tests a device, and writes the report in the formats asked for."""

from __future__ import annotations

import platform
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, TypeVar

import click
import msgspec

from bilprov.analyzer.cli.options import (
    Finite,
    asked_here,
    confirm_motion,
    line_options,
    milliseconds,
    note,
    note_hindrances,
    note_suspension,
)
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.help import PanelCommand, panel
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.signals import Stopper, undisturbed
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance.api import (
    Options,
    estimated,
    opening_and_reading_cases,
    planned,
    run_suite,
    select_cases,
)
from bilprov.conformance.cases.budget import group
from bilprov.conformance.cases.levels import COMPLETE, LEVELS, STANDARD, AnyCase
from bilprov.conformance.cases.proof import announcement
from bilprov.conformance.cases.run_movement import run_movement
from bilprov.conformance.cases.selection import matching, shard_named
from bilprov.conformance.cli import completion
from bilprov.conformance.cli.options import (
    expect_failures_option,
    expected_file,
    gathered,
    named_device,
    read_profile,
    update_expected_option,
    with_expected,
)
from bilprov.conformance.cli.outputs import (
    Output,
    deliver,
    onto_standard_output,
    output_options,
    require_writable,
)
from bilprov.conformance.dut.port_link import by_command
from bilprov.conformance.dut.probes import PROBES, asks_person
from bilprov.conformance.dut.target import (
    PORT,
    SIM,
    Target,
    TargetName,
    open_target,
    target_named,
)
from bilprov.conformance.oracle.choices import parse_allowed
from bilprov.conformance.oracle.profile import profile_text
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.executor import is_slow
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.movement import movement_words
from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """The options that say what is tested and how it is reached."""

    target: str
    probe: str | None
    power: str | None
    fault: str | None
    variant: str | None
    baud: int | None
    parity: str | None
    stopbits: str | None
    yes: bool
    reconnect: float | None = None

    def settings(self, protocol: Protocol, name: TargetName) -> LineSettings:
        """The line's settings; the simulator and boards have the grammar's. Raises ValueError."""
        if name.kind != PORT:
            return line_settings(protocol, None, None, None)
        return line_settings(protocol, self.baud, self.parity, self.stopbits)

    def fitting(self, name: TargetName) -> RobotOptions:
        """The options without the settings that are for ports only, if this is none.

        Raises UsageError for an option of the command line that is not for this kind of target.
        """
        probe = self.probe if asked_here("probe") or not name.own_probe else None
        power = self.power if asked_here("power") or name.kind == PORT else None
        if name.own_probe and probe not in (None, SIM):
            raise click.UsageError(
                f"the target {name.text} brings its own probe; --probe {probe} is for ports"
            )
        if name.kind != SIM and (self.fault or self.variant):
            option = "--fault" if self.fault else "--variant"
            raise click.UsageError(
                f"{option} is for the target sim; start `bilprov simulate {option}`"
            )
        if self.reconnect is not None and name.kind != PORT:
            raise click.UsageError(f"--reconnect is for ports; {name.text} is not a port")
        if power is not None and (name.kind != PORT or not power.startswith("exec:")):
            raise click.UsageError(f"--power {power}: it takes exec:COMMAND, and is for ports")
        return replace(self, probe=probe, power=power)


def _milliseconds(name: str, text: str) -> Callable[[Command], Command]:
    return click.option(name, metavar="MS", type=milliseconds, help=text)


@click.command(cls=PanelCommand)
@click.argument(
    "target",
    metavar="PORT|sim|emulator:KIND:FIRMWARE",
    type=PortName(),
)
@panel(
    "Device",
    click.option(
        "--probe",
        help=f"What sees a stop: {', '.join(kind.form for kind in PROBES)} (the default for a "
        "port) "
        "or sim (the target sim's own).",
    ),
    click.option("--power", metavar="exec:COMMAND", help="A command that switches it off and on."),
    line_options,
    click.option("--yes", is_flag=True, help="The robot may move: do not ask."),
    click.option(
        "--reconnect",
        metavar="S",
        type=Finite(0, 86_400, min_open=True),
        help="Wait so long for a port that is unplugged, then continue: the case is inconclusive.",
    ),
    click.option(
        "--fault",
        metavar="NAME",
        shell_complete=completion.faults,
        help="With sim: misbehave in this way; random:SEED or random:SEED.NUMBER draws one.",
    ),
    click.option(
        "--variant",
        metavar="NAME",
        shell_complete=completion.variants,
        help="With sim: read the document in this legal way.",
    ),
)
@panel(
    "Cases",
    click.option(
        "--level",
        metavar="LEVEL",
        type=click.Choice(list(LEVELS)),
        default=STANDARD.name,
        show_default=True,
        help="; ".join(f"{level.name}: {level.promise}" for level in LEVELS.values()) + ".",
    ),
    click.option(
        "--only",
        multiple=True,
        metavar="GLOB",
        help="Only these cases; * crosses /.",
    ),
    click.option("--list", "listing", is_flag=True, help="List the cases and send nothing."),
    click.option("--fail-fast", is_flag=True, help="End after the first failure."),
    click.option(
        "--shard", "share", metavar="I/N", help="Run the I-th of N equal shares; see bilprov merge."
    ),
    click.option(
        "--seed",
        type=int,
        default=1,
        show_default=True,
        help="Seed for the choice of data and motions.",
    ),
    click.option(
        "--extra",
        metavar="N",
        type=click.IntRange(0),
        default=0,
        help="With --level complete: find devices of up to N more states than the Protocol's "
        "machine.",
    ),
    click.option(
        "--soak",
        metavar="N",
        type=click.IntRange(0),
        default=0,
        help="Add N faults, in a random sequence for every 1,000 of them.",
    ),
)
@panel(
    "Time",
    click.option(
        "--budget",
        metavar="S",
        type=Finite(1, 86_400),
        help="Drop the cases that add least per second, and list them; fill the time left with "
        "random ones.",
    ),
    _milliseconds("--deadline", "How soon an answer is due: later is slow, and non-strict."),
    _milliseconds("--silence", "How long the line is listened to after an answer."),
    _milliseconds("--truncation-timeout", "The pause that ends a frame; measured unless given."),
    click.option(
        "--patient",
        is_flag=True,
        help="Continue when the run takes more than three times as long as announced; "
        "otherwise it ends (3, or 1 if a case failed).",
    ),
)
@panel(
    "Reports",
    output_options(),
    click.option("--record", metavar="FILE.mcap", help="Record the run into a new capture."),
    click.option("-v", "--verbose", is_flag=True, help="List every case that did not pass."),
)
@panel(
    "Known failures",
    expect_failures_option,
    update_expected_option,
    click.option(
        "--allow",
        multiple=True,
        metavar="NAME=VALUE",
        help="Accept a choice that fails otherwise: led-upper=ignore, led-id=ID, version=1.0, "
        "unused-length=header-only, pipelining=no.",
    ),
    click.option(
        "--profile",
        "profile_path",
        metavar="FILE.toml",
        help="Compare the device with this profile; a missing file is written from this run.",
    ),
    click.option("--strict", is_flag=True, help="Count non-strict as failed."),
)
@click.pass_obj
@gathered("robot", RobotOptions)
@gathered("options", Options)
def conform(
    grammar: str | None,
    robot: RobotOptions,
    options: Options,
    share: str | None,
    listing: bool,
    profile_path: str | None,
    outputs: list[Output],
    expect_failures: str | None,
    update_expected: bool,
    record: str | None,
    patient: bool,
    verbose: bool,
) -> int:
    """Test a device against the document: its answers, its safety stop, its state.

    Examples:
      bilprov conform sim --fault no-stop-on-bad-data --html report.html
      bilprov conform /dev/ttyUSB0 --probe tcp:127.0.0.1:7001

    PORT is a path or a pyserial URL of a device that will move; sim is the built-in simulator, in
    virtual time; emulator:simavr:FILE.elf runs a board's firmware.

    Exit code: 0 conforms, 1 does not, 2 the port or the probe cannot be used, 3 nothing failed but
    something could not be judged. If a file or the output on the screen cannot be written, the run
    still goes on to its end, and the exit code is 2.
    """
    protocol = load_protocol(grammar)
    given = read_profile(protocol, profile_path, options.allow)
    try:
        name = target_named(robot.target)
        settings = robot.settings(protocol, name)
        parse_allowed(protocol, options.allow)
        if options.extra and options.level != COMPLETE.name:
            raise ValueError(f"--extra {options.extra} is for --level {COMPLETE.name}")
        shard = shard_named(share) if share is not None else None
        options = replace(options, profile=given, shard=shard)
        cases = select_cases(protocol, options, settings)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    if listing:
        chosen = matching(options.only or "*")
        for case in filter(
            lambda case: chosen(case.id), (*opening_and_reading_cases(protocol), *cases)
        ):
            click.echo(f"{case.id:28} {case.clause:20} {case.requirement}")
        return 0
    promise_verdict()
    robot = robot.fitting(name)
    fresh = profile_path if not given else None
    require_writable(outputs)
    known = expected_file(protocol, options, expect_failures, settings, update=update_expected)
    opened = partial(
        open_target,
        protocol,
        name,
        settings=settings,
        probe=robot.probe,
        power=by_command(robot.power.removeprefix("exec:")) if robot.power else None,
        fault=named_device(protocol, robot.fault, robot.variant),
        reconnect=robot.reconnect or 0.0,
    )
    report, broken = _tested(opened, options, cases, record, robot, patient=patient)
    onto_stdout = onto_standard_output(outputs)
    if fresh is not None and not report.unusable:
        outputs.append(Output("--profile", fresh, _profile))
    # What can be written is, even if something else fails: the robot should not drive again for it.
    try:
        with undisturbed(again=False):
            report = with_expected(report, known, expect_failures)
    finally:
        try:
            deliver(outputs, [report], protocol)
        finally:
            from bilprov.conformance.report.summary import show, summary_console

            show(report, summary_console(stderr=onto_stdout), everything=verbose)
    if fresh is not None and not report.unusable:
        note(f"{fresh}: the profile of this device; give it again with --profile")
    if broken:
        raise broken
    return report.exit


def _tested(
    opened: Callable[[Stopper], AbstractContextManager[Target]],
    options: Options,
    cases: Sequence[AnyCase],
    record: str | None,
    robot: RobotOptions,
    *,
    patient: bool,
) -> tuple[Report, Exception | None]:
    """Open the target, ask whether a robot may move, and run the cases.

    Gives the report, and why the recording ended before the run did, None if it did not.
    """
    from bilprov.conformance.cli.progress import Progress

    start = time.monotonic()
    with ExitStack() as stack:
        stopper = stack.enter_context(closing(Stopper()))
        target = stack.enter_context(opened(stopper))
        count = planned(target.protocol, options, cases)
        if options.level == COMPLETE.name:
            seconds = estimated(target, options, cases)
            groups = {group(case.id) for case in cases}
            said = announcement(target.protocol, options.extra, groups)
            note(f"{said}; about {_time(seconds)} on the line" if said else "no proof")
        if target.moves:
            note_hindrances(robot.target)
            seconds = estimated(target, options, cases)
            looks = target.environment.observability
            movement = run_movement(
                target.protocol, cases, looks=looks.available and not looks.costly
            )
            words = movement_words(target.protocol, movement)
            what = f"the robot at {robot.target} will move for about {_time(seconds)}: {words}"
            confirm_motion(target.protocol, what, yes=robot.yes)
            look = target.look_time
            slow = f"an observation takes {look / MS:.0f} ms; " if is_slow(look / 1e9) else ""
            note(
                f"{quantity(count, 'case')}, {_time(seconds)} or more: {slow}"
                "a device that answers late or not at all takes longer"
            )
            if not patient and not asks_person(robot.probe):
                environment = msgspec.structs.replace(target.environment, announced=seconds)
                target = replace(target, environment=environment)
            start = time.monotonic()  # the time until the user confirmed does not count
        stack.enter_context(stopper)
        if target.moves:
            stopper.before_suspending(target.halt)
        listeners: list[RunListener] = []
        if record is not None:
            from bilprov.conformance.runner.listeners.recorder import open_recorder

            recorder = open_recorder(record, target, options.truncation_timeout)
            listeners.append(stack.enter_context(recorder))
        progress = Progress(count, shown=not asks_person(robot.probe))
        listeners.append(stack.enter_context(progress))
        report = run_suite(target, options, listeners)
        if target.remark():
            note(target.remark())
    note_suspension(stopper)
    broken = next((listener.broken for listener in listeners if listener.broken), None)
    return _dated(report, start), broken


def _time(seconds: float) -> str:
    """A duration in words: in seconds, in hours where it is over one."""
    return f"{seconds:.0f} s" if seconds <= 3600 else f"{seconds / 3600:.1f} hours"


def _dated(report: Report, start: float) -> Report:
    """The report of a run that ends now, with begin, duration, host and versions added."""
    from importlib.metadata import version

    took = time.monotonic() - start
    versions = {"Python": platform.python_version(), "platform": platform.platform()}
    return msgspec.structs.replace(
        report,
        begun=(datetime.now(UTC) - timedelta(seconds=took)).isoformat(timespec="seconds"),
        took_s=round(took, 3),
        host=socket.gethostname(),
        versions=versions | {name: version(name) for name in ("pyserial", "construct")},
    )


def _profile(reports: Sequence[Report], protocol: Protocol) -> str:
    (report,) = reports
    return profile_text(report.grammar, report.profile)
