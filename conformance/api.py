"""Runs the suite, for Python: on a device object in virtual time, or on an open port."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Protocol

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings, line_named, line_settings
from bilprov.analyzer.transport.port import Port
from bilprov.captures.schemas import MS
from bilprov.captures.text import printable
from bilprov.conformance.cases.budget import dropped, within
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.duration import before_the_cases, seconds
from bilprov.conformance.cases.levels import (
    LEVELS,
    SEQUENCE_PREFIXES,
    AnyCase,
    level_cases,
    single_cases,
)
from bilprov.conformance.cases.opening import opening_cases, truncation_timeout
from bilprov.conformance.cases.selection import CONDITIONAL_CASES, matching, reaches, share
from bilprov.conformance.dut.checked_device import CheckedDevice
from bilprov.conformance.dut.link import Device, Link, LinkListener, drive
from bilprov.conformance.dut.port_link import PortLink
from bilprov.conformance.dut.power import Power
from bilprov.conformance.dut.probes import Probe
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.conformance.oracle.choices import Choices, parse_allowed
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.profile_file import profile_from
from bilprov.conformance.oracle.timers import Observability
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.report.run_report import Ending, Report, RunFacts, make_report
from bilprov.conformance.runner.discovery.discover import reading_cases
from bilprov.conformance.runner.environment import Environment
from bilprov.conformance.runner.executor import Runner, SkipPolicy
from bilprov.conformance.runner.listeners.journal import RunJournal, journalled
from bilprov.conformance.runner.listeners.meter import Meter
from bilprov.conformance.runner.listeners.wire_log import WireLog
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol as Grammar


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run; times are in milliseconds, None for the grammar's or the kit's own.

    `only` are globs of case ids in which * crosses /; none means all. `seed` governs how data and
    motions rotate through the cases. `strict` counts non-strict as failed, `fail_fast` ends the run
    after the first failure. `deadline` is how soon an answer is due: what is later is slow, what is
    later than the grammar's longest fails. `silence` is how long the line is listened to after an
    answer, `truncation_timeout` the pause that ends a frame (measured if None). `level` names the
    suite's level, `soak` how many faults more are sent at its end. `allow` are the choices
    (NAME=VALUE) that would fail otherwise. `budget` (s) keeps the cases that add most a second,
    `profile` is the text of a device's profile, "" for none. `shard` (I, N) runs the I-th of N
    shares of the cases.
    """

    only: tuple[str, ...] = ()
    seed: int = 1
    strict: bool = False
    fail_fast: bool = False
    deadline: float | None = None
    silence: float | None = None
    truncation_timeout: float | None = None
    level: str = "standard"
    soak: int = 0
    allow: tuple[str, ...] = ()
    budget: float | None = None
    profile: str = ""
    shard: tuple[int, int] | None = None


class RunListener(Protocol):
    """Receives the begin and the result of each case of a run."""

    def begin(self, ident: str) -> None:
        """A case begins."""

    def end(self, result: CaseResult) -> None:
        """A case is final."""


class SilentListener:
    """A run listener that does nothing."""

    def begin(self, ident: str) -> None:
        """A case begins."""

    def end(self, result: CaseResult) -> None:
        """A case is final."""


def select_cases(
    grammar: Grammar, options: Options, line: LineSettings | None = None
) -> tuple[AnyCase, ...]:
    """The cases of a run, besides those that open every run.

    `line` are the line's settings, which decide what a budget and a shard hold; the grammar's own
    if None. Raises ValueError when `only` matches none of these cases and none of the opening ones,
    for a glob with characters that no id has, and for a shard that there is not.
    """
    for glob in options.only:
        if not glob.isprintable():
            raise ValueError(
                f"{printable(glob)} is no glob of case ids, which are letters, digits, - and /; "
                "see them with --list"
            )
    if options.only and not reaches(options.only, SEQUENCE_PREFIXES):
        cases: tuple[AnyCase, ...] = single_cases(grammar, options.level, options.seed)
    else:
        cases = level_cases(grammar, options.level, options.seed, options.soak)
    if options.only:
        wanted = matching(options.only)
        chosen = tuple(case for case in cases if wanted(case.id))
        if not chosen and not any(wanted(case.id) for case in opening_and_reading_cases(grammar)):
            raise ValueError(
                f"no case matches {' or '.join(options.only)}; see the ids with --list, for "
                f"example --only '{cases[0].id.split('/')[0]}/*'"
            )
        cases = chosen

    def cost(case: AnyCase) -> float:
        return estimated_seconds(grammar, [case], options, line)

    if options.budget is not None:
        left = options.budget - before_the_cases(grammar.timing.truncation_timeout / 1000)
        cases = within(grammar, cases, left, cost)
    return cases if options.shard is None else share(cases, options.shard, cost)


def opening_and_reading_cases(grammar: Grammar) -> tuple[Case, ...]:
    """The cases that every run has: the opening, and the probes of the device's choices."""
    return (*opening_cases(grammar), *reading_cases(grammar))


def planned(grammar: Grammar, options: Options, cases: Sequence[AnyCase]) -> int:
    """How many cases a run of `cases` has with the opening ones, before a fault adds more.

    What a profile or an option already states about the device is not measured again.
    """
    opening = opening_cases(grammar) if options.profile else opening_and_reading_cases(grammar)
    known = bool(options.profile or options.truncation_timeout)
    return len(opening) + len(cases) - (known and truncation_timeout(grammar) is not None)


def suite_ids(
    grammar: Grammar, options: Options, line: LineSettings | None = None
) -> tuple[str, ...]:
    """The ids of every case that a run has with these options if nothing is left out."""
    whole = replace(options, only=(), shard=None)
    cases = (*opening_and_reading_cases(grammar), *select_cases(grammar, whole, line))
    return (*(case.id for case in cases), *CONDITIONAL_CASES)


def conform(
    device: Device | None = None,
    *,
    grammar: Grammar | None = None,
    options: Options | None = None,
    listener: RunListener | None = None,
    tap: LinkListener | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    name: str = "sim",
    probe: str = "sim",
    fault: str | None = None,
    spare: SkipPolicy | None = None,
    logged: bool = True,
) -> Report:
    """Run every case on a device object in virtual time: no waiting, the same result every time.

    `device` is anything with the four methods of `conformance.dut.link.Device` (times in ns), the
    kit's own simulator if None; one without `look` is judged by its answers alone. `name`, `probe`
    and `fault` only name the device, its probe and its fault in the report. `spare` decides before
    each case, from its id and the results so far, whether to skip it. Without `logged` no case
    keeps its wire log. Raises ValueError when no case is left to run, and DeviceError, in one
    sentence, for a device object that does not keep to its four methods.
    """
    grammar = grammar or load_protocol()
    options = options or Options()
    device = device or Simulator(grammar)
    line = grammar.line
    settings = LineSettings(line.baud, line.parity, line.stopbits)
    own = isinstance(device, Simulator)
    link = VirtualLink(device if own else CheckedDevice(device), settings.byte_time, tap)
    observability = Observability(hasattr(device, "look"), why="the device object has no look")
    about = {
        "kind": "virtual",
        "line": str(settings),
        "probe": probe if observability.available else "none",
        "fault": fault,
    }
    return run_on(
        link,
        Environment(True, observability, hasattr(device, "power_cycle"), name, about),
        grammar=grammar,
        options=options,
        listener=listener,
        interrupted=interrupted,
        tap=tap,
        spare=spare,
        logged=logged,
    )


def conform_port(
    port: Port,
    probe: Probe | None,
    probe_name: str,
    *,
    grammar: Grammar,
    options: Options,
    stop: int,
    interrupted: Callable[[], bool | str],
    listener: RunListener | None = None,
    tap: LinkListener | None = None,
    power: Power | None = None,
    name: str | None = None,
) -> Report:
    """Run the cases on an open port in real time; the robot moves.

    `stop` is a descriptor that is readable once the user wants to stop, `interrupted` says whether
    that is so. `power` switches the robot off and on. `name` says in the report what the device is,
    the port's own name unless given. Raises ValueError when no case is left to run.
    """
    if probe is None:
        observability = Observability(available=False)
    else:
        observability = Observability(
            True, probe.costly, f"{probe_name} is asked only about a few cases"
        )
    about = {
        "kind": "port",
        "line": str(port.settings),
        "baud": port.settings.baud,
        "probe": probe_name,
    }
    try:
        return run_on(
            PortLink(port, probe, stop, tap, power),
            Environment(False, observability, power is not None, name or port.name, about),
            grammar=grammar,
            options=options,
            listener=listener,
            interrupted=interrupted,
            tap=tap,
        )
    except BaseException:
        # A fault of the kit itself must not leave the robot driving.
        with contextlib.suppress(LinkError):
            port.write(bytes([grammar.pad_byte]) * grammar.longest_frame)
        raise


def run_on(
    link: Link,
    environment: Environment,
    *,
    grammar: Grammar,
    options: Options,
    listener: RunListener | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    tap: LinkListener | None = None,
    spare: SkipPolicy | None = None,
    logged: bool = True,
) -> Report:
    """Run the cases over a link, live or recorded; every run goes through this function.

    Raises ValueError when no case is left to run.
    """
    line = line_named(grammar, str(environment.link.get("line", "")))
    cases = select_cases(grammar, options, line)
    journal = tap if isinstance(tap, RunJournal) else None
    if journal:
        journal.begins(grammar, options, environment)
        link, interrupted = journalled(link, interrupted, journal)
    log = WireLog()
    meter = Meter(line.byte_time)
    link = meter.over(log.over(link) if logged else link)
    listener = listener or SilentListener()
    deadline = options.deadline or grammar.timing.answer_deadline
    timers = environment.timers(grammar).due_within(int(deadline * MS))
    timers = replace(timers, idle=LEVELS[options.level].idle * MS)
    if options.budget is not None and timers.run_budget is not None:
        timers = replace(timers, run_budget=int(options.budget * 1e9))
    if options.silence:
        timers = replace(timers, silence=int(options.silence * MS))
    allowed = parse_allowed(grammar, options.allow)
    profile = Profile(choices=Choices(allowed=allowed))
    if options.profile:
        profile = profile_from(grammar, options.profile, allowed)

    def begin(ident: str) -> None:
        if logged:
            log.begin(ident)
        listener.begin(ident)

    if options.truncation_timeout is not None:
        profile.truncation_timeout = int(options.truncation_timeout * MS)
    run = Run(
        RunConfig(grammar, timers, environment.observability, environment.power),
        profile,
        begin=begin,
        report=lambda result: listener.end(log.attached(result)),
    )
    timeout_case = truncation_timeout(grammar)
    asked = timeout_case is not None and matching(options.only)(timeout_case.id)
    runner = Runner(
        run,
        cases,
        fail_fast=options.fail_fast,
        measure=asked,
        discover=not options.profile,
        spare=spare,
    )
    drive(runner.execute(), link, interrupted)
    report = make_report(
        grammar,
        [log.attached(result) for result in run.results],
        cases,
        run.profile,
        RunFacts(
            environment.device,
            environment.link,
            asdict(options),
            meter.report(run.waiting.timeouts),
            _dropped(grammar, options, cases, line),
        ),
        Ending.of(runner.unusable, runner.ended),
    )
    if journal:
        journal.reported(report)
    return report


def _dropped(
    grammar: Grammar, options: Options, cases: Sequence[AnyCase], line: LineSettings
) -> dict[str, int]:
    """How many cases of each group the budget has left out."""
    if options.budget is None:
        return {}
    return dropped(select_cases(grammar, replace(options, budget=None, shard=None), line), cases)


def estimated_seconds(
    grammar: Grammar,
    cases: Sequence[AnyCase],
    options: Options,
    line: LineSettings | None = None,
) -> float:
    """About how long the cases take on a port, in s: the wire, silences and time-outs, looks.

    `line` are the line's settings, the grammar's own if None.
    """
    timeout = (options.truncation_timeout or grammar.timing.truncation_timeout) / 1000
    line = line or line_settings(grammar, None, None, None)
    byte_time = line.byte_time / 1e9
    return sum(seconds(grammar, case, byte_time, timeout) for case in cases)
