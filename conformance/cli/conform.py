"""`bilprov conform`: tests a device, and writes the report in the formats asked for."""

from __future__ import annotations

import platform
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TYPE_CHECKING, Any

import click
import msgspec

from bilprov.analyzer.cli.command import command, family_protocol, flag, group, option, refuse
from bilprov.analyzer.cli.options import Finite, milliseconds, note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.client.probes import ASK
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.signals import Stopper, ending_requested
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance import api
from bilprov.conformance.api import Options
from bilprov.conformance.cases import budget
from bilprov.conformance.cases.budget import run_movement
from bilprov.conformance.cases.levels import COMPLETE, LEVELS, STANDARD, AnyCase, matching
from bilprov.conformance.cases.proof import announcement
from bilprov.conformance.cli.last_run import LastRun, Run, last_run, ordered
from bilprov.conformance.cli.options import read_profile, seed_option
from bilprov.conformance.cli.outputs import FORMATS, Output, Outputs, outputs_option, write_each
from bilprov.conformance.cli.robot import RobotOptions
from bilprov.conformance.dut.target import Target, TargetName
from bilprov.conformance.oracle.profile import parse_allowed
from bilprov.conformance.report.expected import ExpectedFile
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.executor import is_slow
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from rich.console import Console


class CaseOptions(msgspec.Struct, frozen=True):
    """Which cases are run."""

    level: str = option(
        metavar="LEVEL",
        type=click.Choice(list(LEVELS)),
        default=STANDARD.name,
        help="; ".join(f"{level.name}: {level.promise}" for level in LEVELS.values()) + ".",
    )
    only: tuple[str, ...] = option(
        multiple=True, metavar="GLOB", help="Only these cases; * crosses /."
    )
    listing: bool = flag("List the cases and send nothing.", "--list")
    last_failed: bool = flag("Only what failed in the last run of this device; all if nothing did.")
    failed_first: bool = flag("First what failed in the last run of this device, then the others.")
    fail_fast: bool = flag("End after the first failure.")
    seed: int = seed_option(help="Seed for the choice of data and motions.")
    extra: int = option(
        metavar="N",
        type=click.IntRange(0),
        default=0,
        help="With --level complete: find devices of up to N more states than the Protocol's "
        "machine.",
    )
    soak: int = option(
        metavar="N",
        type=click.IntRange(0, 1_000_000),
        default=0,
        help="Add N faults, in a random sequence for every 1,000 of them.",
    )


_milliseconds = partial(option, metavar="MS", type=milliseconds)


class TimeOptions(msgspec.Struct, frozen=True):
    """How long the run and its parts take."""

    deadline: float | None = _milliseconds(
        help="How soon an answer is due: later is slow, and non-strict."
    )
    silence: float | None = _milliseconds(help="How long the line is listened to after an answer.")
    truncation_timeout: float | None = _milliseconds(
        help="The pause that ends a frame; measured unless given."
    )
    patient: bool = flag(
        "Continue when the run takes more than three times as long as announced; "
        "otherwise it ends (3, or 1 if a case failed)."
    )


class ReportOptions(msgspec.Struct, frozen=True):
    """What is written of the run."""

    outputs: dict[str, str] = outputs_option()
    record: str | None = option(metavar="FILE.mcap", help="Record the run into a new capture.")
    verbose: bool = flag("List every case that did not pass.", "-v", "--verbose")


class KnownOptions(msgspec.Struct, frozen=True):
    """What is known of the device, and does not count as a failure."""

    expect_failures: str | None = option(
        metavar="FILE",
        help="Failures that do not count: lines of GLOB : AXIS: MESSAGE, a glob of case ids, the "
        "axis that fails (answer, stop, state) and, optionally, the message; # begins a comment. "
        "One that no longer fails is itself a failure.",
    )
    update_expected: bool = flag("Rewrite that file from what fails now; comments stay.")
    allow: tuple[str, ...] = option(
        multiple=True,
        metavar="NAME=VALUE",
        help="Accept a choice that fails otherwise: led-upper=ignore, led-id=ID, version=1.0, "
        "unused-length=header-only, pipelining=no.",
    )
    profile_path: str | None = option(
        "--profile",
        metavar="FILE.toml",
        help="Compare the device with this profile; a missing file is written from this run.",
    )
    strict: bool = flag("Count non-strict as failed.")


class ConformOptions(msgspec.Struct, frozen=True):
    """The options of `conform`, by the headings of its help."""

    robot: RobotOptions = group(RobotOptions, "Device")
    reconnect: float | None = option(
        metavar="S",
        type=Finite(0, 86_400, min_open=True),
        heading="Device",
        help="Wait so long for a port that is unplugged, then continue: the case is inconclusive.",
    )
    cases: CaseOptions = group(CaseOptions, "Cases")
    watch: bool = flag(
        "Run again whenever the device comes back, what failed last first, until Ctrl-C.",
        heading="Again",
    )
    watch_file: str | None = option(
        metavar="FILE",
        heading="Again",
        help="Run again also when this file has changed, like one that is written after flashing. "
        "The firmware of an emulator is watched without that.",
    )
    times: TimeOptions = group(TimeOptions, "Time")
    reports: ReportOptions = group(ReportOptions, "Reports")
    known: KnownOptions = group(KnownOptions, "Known failures")

    @property
    def watches(self) -> bool:
        """Whether it runs again and again."""
        return self.watch or self.watch_file is not None

    @property
    def led(self) -> bool:
        """Whether what failed last is run first, or alone."""
        return self.watches or self.cases.last_failed or self.cases.failed_first

    def suite(self, profile: str) -> Options:
        """The options of the run itself."""
        given: dict[str, Any] = {}
        for part in (self.cases, self.times, self.known):
            given |= msgspec.structs.asdict(part)
        run = {field.name: given[field.name] for field in fields(Options) if field.name in given}
        return Options(**run, profile=profile)


_OF_A_RUN = (
    *("fail_fast", "reconnect", "watch", "watch_file"),
    *TimeOptions.__struct_fields__,
    *(*FORMATS, "record", "verbose"),
    *("expect_failures", "update_expected", "strict"),
)
"""The parameters that have no use where cases are only listed."""


@command(ConformOptions, only_with={"expect_failures": ("update_expected",)})
def conform(options: ConformOptions) -> int:
    """Examples:
      bilprov conform sim --fault no-stop-on-bad-data --html report.html
      bilprov conform /dev/ttyUSB0 --probe tcp:127.0.0.1:7001

    Its answers are judged, its safety stop and its state. PORT is a path or a pyserial URL of a
    device that will move; sim is the built-in simulator, in virtual time; emulator:simavr:FILE.elf
    runs a board's firmware.

    Exit code: 0 conforms, 1 does not, 2 the port or the probe cannot be used, 3 nothing failed but
    something could not be judged. If a file or the output on the screen cannot be written, the run
    still goes on to its end, and the exit code is 2. With --watch it is that of the last run.
    """
    protocol = family_protocol("conform")
    robot, name, settings = options.robot.fitting(protocol)
    try:
        parse_allowed(protocol, options.known.allow)
        if options.cases.extra and options.cases.level != COMPLETE.name:
            raise ValueError(f"--extra {options.cases.extra} is for --level {COMPLETE.name}")
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    last = last_run(protocol, robot.target, robot.fault, robot.variant)
    plan = _planned(protocol, options, last)
    if options.cases.listing:
        refuse(_OF_A_RUN, "is for a run: leave out --list")
        note(plan.order)
        for case in _asked(protocol, plan.suite, plan.cases):
            click.echo(f"{case.id:28} {case.clause:20} {case.requirement}")
        return 0
    promise_verdict()
    options = msgspec.structs.replace(options, robot=robot)
    _require_own_files(options)
    if not options.watches:
        note(plan.order)
        return _run(protocol, options, (name, settings), plan).report.exit
    from bilprov.conformance.cli.watch import Comeback, watch

    if options.reports.record is not None:
        raise click.UsageError("--record is for one run: leave out --watch")
    comeback = Comeback(name, settings, options.watch_file)
    note(plan.order)
    first = _run(protocol, options, (name, settings), plan)
    robot = msgspec.structs.replace(options.robot, yes=True)  # that was for all runs
    options = msgspec.structs.replace(options, robot=robot)

    def again(at: TargetName, last: LastRun) -> Run:
        return _run(protocol, options, (at, settings), _planned(protocol, options, last))

    return watch(first, again, comeback, _console(Outputs(options.reports.outputs)))


def _require_own_files(options: ConformOptions) -> None:
    """Raise UsageError where a file of the run cannot be written, or would overwrite another."""
    outputs, known = Outputs(options.reports.outputs), options.known
    for name, path in (("--profile", known.profile_path), ("--record", options.reports.record)):
        if path:
            outputs.append(Output(name, path, _profile))
    outputs.require_writable([known.expect_failures] if known.expect_failures else [])


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is run, and why in this order (in words, "" for the usual one).

    `last` is the last run of the device, `fresh` the profile that is to be written from this one.
    """

    suite: Options
    cases: Sequence[AnyCase]
    order: str
    last: LastRun
    fresh: str | None


def _planned(protocol: Protocol, options: ConformOptions, last: LastRun) -> _Plan:
    """What is to be run after the last run. Raises UsageError."""
    known = options.known
    profile = read_profile(protocol, known.profile_path, known.allow)
    suite, order = options.suite(profile), ""
    try:
        cases = api.select_cases(protocol, suite)
        if options.led:
            asked = {case.id for case in _asked(protocol, suite, cases)}
            suite, order = ordered(suite, last, asked, alone=options.cases.last_failed)
            cases = api.select_cases(protocol, suite)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    return _Plan(suite, cases, order, last, known.profile_path if not profile else None)


_At = tuple[TargetName, LineSettings]
"""The name of a device, and the settings of its line."""


def _run(protocol: Protocol, options: ConformOptions, at: _At, plan: _Plan) -> Run:
    """Test the device, write and show the report, and keep what failed.

    From the consent on a signal ends the run itself, and nothing else until the files are written.
    """
    known = options.known
    outputs = Outputs(options.reports.outputs)
    expected = None
    if known.expect_failures is not None:
        suite = api.suite_ids(protocol, plan.suite)
        expected = ExpectedFile(known.expect_failures, suite, update=known.update_expected)
    with ExitStack() as signals:
        report, broken = _tested(protocol, options, at, plan, signals)
        console = _console(outputs)
        fresh = None if report.unusable else plan.fresh
        if fresh is not None:
            outputs.append(Output("--profile", fresh, _profile))
        # What can be written is, even if something else fails: the robot should not drive again.
        try:
            if expected:
                report, changed = expected.applied(report)
                note(changed)
            after = plan.last.after(report)
            after.keep()
        finally:
            try:
                texts = ((one.path, one.write([report], protocol)) for one in outputs)
                write_each(texts, signals)
            finally:
                from bilprov.conformance.report.summary import show

                all_of_it = options.reports.verbose
                show(report, console, everything=all_of_it, brief=options.watches and not all_of_it)
    if fresh is not None:
        note(f"{fresh}: the profile of this device; give it again with --profile")
    if broken:
        raise broken
    return Run(plan.last, report, after)


def _console(outputs: Outputs) -> Console:
    """Where the summary goes: to standard error where a report goes to standard output."""
    from bilprov.conformance.report.summary import summary_console

    return summary_console(stderr=outputs.onto_stdout)


def _asked(protocol: Protocol, suite: Options, cases: Sequence[AnyCase]) -> list[AnyCase]:
    """The cases that are asked for, with those that every run has where they are."""
    wanted = matching(suite.only or "*")
    return [c for c in (*api.opening_and_reading_cases(protocol), *cases) if wanted(c.id)]


def _tested(
    protocol: Protocol, options: ConformOptions, at: _At, plan: _Plan, signals: ExitStack
) -> tuple[Report, Exception | None]:
    """Open the target, ask whether a robot may move, and run the cases.

    From the consent on signals are handled, after the run by `signals`. Gives the report, and why
    the recording ended before the run did, None if it did not.
    """
    from bilprov.conformance.cli.progress import Progress

    robot, record, suite = options.robot, options.reports.record, plan.suite
    asks = robot.probe == ASK
    count = api.planned(protocol, suite, plan.cases)

    def agreed(target: Target) -> Target:
        target = asked(target)
        signals.enter_context(Stopper())
        return target

    def asked(target: Target) -> Target:
        complete = suite.level == COMPLETE.name
        seconds = api.estimated(target, suite, plan.cases) if target.moves or complete else 0.0
        if complete:
            groups = {budget.group(case.id) for case in plan.cases}
            said = announcement(protocol, suite.extra, groups)
            note(f"{said}; about {_time(seconds)} on the line" if said else "no proof")
        if not target.moves:
            return target
        looks = target.environment.observability
        movement = run_movement(protocol, plan.cases, looks=looks.available and not looks.costly)
        again = ", and again whenever it comes back" if options.watches else ""
        robot.confirm(protocol, f"about {_time(seconds)}{again}", movement)
        look = target.look_time
        slow = f"an observation takes {look / MS:.0f} ms; " if is_slow(look / 1e9) else ""
        note(
            f"{quantity(count, 'case')}, {_time(seconds)} or more: {slow}"
            "a device that answers late or not at all takes longer"
        )
        if options.times.patient or asks:
            return target
        environment = msgspec.structs.replace(target.environment, announced=seconds)
        return replace(target, environment=environment)

    opened = robot.driven(protocol, *at, agreed, options.reconnect or 0.0)
    with opened as (target, stopper), ExitStack() as stack:
        start = time.monotonic()  # the time until the user confirmed does not count
        if ending_requested():  # while the port was opened
            stopper.stop()
        listeners: list[RunListener] = []
        if record is not None:
            from bilprov.conformance.runner.listeners.recorder import RunRecorder

            recorder = RunRecorder(record, target, suite.truncation_timeout)
            listeners.append(stack.enter_context(recorder))
        progress = Progress(count, shown=not asks)
        listeners.append(stack.enter_context(progress))
        report = api.run_suite(target, suite, listeners)
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
    return report.profile.toml(protocol)
