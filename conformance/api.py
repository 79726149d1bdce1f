"""Runs the suite, for Python: on a device object in virtual time, or on any opened target."""

from __future__ import annotations

import typing
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace

from bilprov.analyzer.client.operations import Procedure, finished, interruption, steps
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS
from bilprov.conformance.cases import levels
from bilprov.conformance.cases.budget import Pace, before_the_cases, seconds
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.levels import Options as Options
from bilprov.conformance.cases.single_frames import opening_cases, truncation_timeout
from bilprov.conformance.causes.explained import Explainer
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import SIM, Device, Target, device_target
from bilprov.conformance.oracle.profile import (
    Choices,
    Profile,
    Timers,
    parse_allowed,
    profile_from,
    timers_of,
)
from bilprov.conformance.oracle.verdicts import CaseResult, Cause
from bilprov.conformance.report.run_report import Report, make_report
from bilprov.conformance.runner.discovery.discover import reading_cases
from bilprov.conformance.runner.executor import Runner, SkipPolicy, is_slow
from bilprov.conformance.runner.listeners.listener import Meter, ObservedLink, RunListener, WireLog
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.spec.protocol import Protocol as Grammar
from bilprov.spec.protocol import require_family


def select_cases(grammar: Grammar, options: Options) -> tuple[AnyCase, ...]:
    """The cases of a run, besides those that open every run.

    Raises ValueError when `only` matches none of these cases and none of the opening ones,
    and for a glob with characters that no id has.
    """
    for glob in options.only:
        if not glob.isprintable() or len(glob) > levels.LONGEST_GLOB:
            raise ValueError(
                f"{glob} is not a glob of case ids, which are letters, digits, - and /, "
                f"of up to {levels.LONGEST_GLOB} characters; see them with --list"
            )
    if options.only and not levels.reaches(options.only, levels.SEQUENCE_PREFIXES):
        cases: tuple[AnyCase, ...] = levels.single_cases(grammar, options.level, options.seed)
    else:
        left_out = frozenset(
            group
            for group in levels.INDEPENDENT_GROUPS
            if options.only and not levels.reaches(options.only, (f"{group}/",))
        )
        cases = levels.level_cases(
            grammar, options.level, options.seed, options.soak, options.extra, left_out
        )
    if options.only:
        wanted = levels.matching(options.only)
        chosen = tuple(case for case in cases if wanted(case.id))
        if not chosen and not any(wanted(case.id) for case in opening_and_reading_cases(grammar)):
            raise ValueError(
                f"no case matches {' or '.join(options.only)}; see the ids with --list, for "
                f"example --only '{cases[0].id.split('/')[0]}/*'"
            )
        cases = chosen

    early = frozenset(options.first)
    return tuple(sorted(cases, key=lambda case: case.id not in early)) if early else cases


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


def suite_ids(grammar: Grammar, options: Options) -> tuple[str, ...]:
    """The ids of every case that a run has with these options if nothing is left out."""
    whole = replace(options, only=())
    cases = (*opening_and_reading_cases(grammar), *select_cases(grammar, whole))
    return (*(case.id for case in cases), *levels.CONDITIONAL_CASES)


def conform(
    device: Device | None = None,
    *,
    grammar: Grammar | None = None,
    options: Options | None = None,
    listener: RunListener | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    name: str = SIM,
    probe: str = SIM,
    fault: str | None = None,
    logged: bool = True,
) -> Report:
    """Run every case on a device object in virtual time: no waiting, the same result every time.

    `device` is anything with the four methods of `conformance.dut.link.Device` (times in ns), the
    kit's own simulator if None; one without `look` is judged by its answers alone, and where its
    attribute `lossless` is True one unexplained mismatch is a failure. `listener` is told of the
    run and of what passes over the link. `name`, `probe` and `fault` only name the device, its
    probe and its fault in the report; `logged` is `run_suite`'s. Raises
    ValueError when no case is left to run, and DeviceError, in one sentence, for a device object
    that does not keep to its four methods.
    """
    grammar = grammar or load_protocol()
    device = device or Simulator(grammar)
    target = device_target(grammar, device, name=name, probe=probe, fault=fault)
    target, listeners = replace(target, interrupted=interrupted), [listener] if listener else []
    explainer = Explainer if logged else None
    return run_suite(target, options or Options(), listeners, logged=logged, explainer=explainer)


class Afterwards(typing.Protocol):
    """What is done with the device when all cases are judged, and the causes that it gives."""

    def try_again(self) -> Procedure[None]:
        """Do it; the line is homed before and after."""

    def causes(self) -> tuple[Cause, ...]:
        """The causes of what failed."""


def run_suite(
    target: Target,
    options: Options,
    listeners: Sequence[RunListener] = (),
    *,
    skip: SkipPolicy | None = None,
    logged: bool = True,
    explainer: Callable[[Run, Trace, int], Afterwards] | None = Explainer,
) -> Report:
    """Run the cases on a target, live or recorded, to the end, as `suite_steps` does."""
    return finished(
        suite_steps(target, options, listeners, skip=skip, logged=logged, explainer=explainer)
    )


def suite_steps(
    target: Target,
    options: Options,
    listeners: Sequence[RunListener] = (),
    *,
    skip: SkipPolicy | None = None,
    logged: bool = True,
    explainer: Callable[[Run, Trace, int], Afterwards] | None = Explainer,
) -> Generator[None, None, Report]:
    """Run the cases on a target, and yield after each operation; every run goes through this.

    `listeners` are told of the run while it goes on; one that is `broken` ends it. `skip` decides
    before each case, from its id and the results so far, whether to skip it. Without `logged` no
    case keeps its wire log. `explainer` finds the causes of what failed, none if it is None. Raises
    ValueError when no case is left to run, GrammarError for a protocol outside the robot car's
    family.
    """
    grammar = target.protocol
    require_family(grammar, "the suite")
    log, meter = WireLog(), Meter(target.byte_time)
    trace = Trace()
    everyone = (*listeners, meter, log) if logged else (*listeners, meter)
    if explainer:
        everyone = (*everyone, trace)
    link = ObservedLink(target.connect, everyone)
    cases = select_cases(grammar, options)
    for listener in everyone:
        listener.begins(grammar, options, target.environment)

    def begin(ident: str) -> None:
        for listener in everyone:
            listener.begin(ident)

    judged: dict[str, CaseResult] = {}

    def end(result: CaseResult) -> None:
        judged[result.id] = result = log.attached(result)
        for listener in everyone:
            listener.end(result)

    def note(sentence: str) -> None:
        for listener in everyone:
            listener.note(sentence)

    def interrupted() -> bool | str:
        why = target.interrupted()
        for listener in listeners:
            if listener.broken and not why:
                why = str(listener.broken)
        if why:
            link.done(None, interruption(why))
        return why

    profile = _profile(grammar, options)
    if options.truncation_timeout is not None:
        profile.truncation_timeout = int(options.truncation_timeout * MS)
    environment = target.environment
    run = Run(
        RunConfig(
            grammar,
            _timers(target, options),
            environment.observability,
            environment.power,
            environment.virtual,
            environment.lossless,
            target.look_time,
            environment.announced,
        ),
        profile,
        begin=begin,
        report=end,
        note=note,
    )
    explains = explainer(run, trace, target.byte_time) if explainer else None
    timeout_case = truncation_timeout(grammar)
    asked = timeout_case is not None and levels.matching(options.only)(timeout_case.id)
    runner = Runner(
        run,
        cases,
        fail_fast=options.fail_fast,
        measure=asked,
        discover=not options.profile,
        spare=skip,
        afterwards=explains.try_again if explains else None,
    )
    try:
        yield from steps(runner.execute(), link, interrupted)
        report = make_report(
            grammar,
            [judged[result.id] for result in run.results],
            cases,
            run.profile,
            options,
            unusable=runner.unusable,
            ended=runner.ended,
            device=environment.device,
            link=environment.link,
            unseen=tuple(run.sight.sentences()),
            notices=tuple(run.notices),
            timing=meter.report(run.waiting.timeouts),
            causes=explains.causes() if explains else (),
        )
        for listener in everyone:
            listener.reported(report)
    except BaseException:
        # A fault of the kit itself must not leave the robot driving.
        target.halt()
        raise
    return report


def _timers(target: Target, options: Options) -> Timers:
    """The timers of the target's environment with the options applied to them."""
    deadline = options.deadline or target.protocol.timing.answer_deadline
    timers = timers_of(target.environment, target.protocol).due_within(int(deadline * MS))
    timers = replace(timers, idle=levels.LEVELS[options.level].idle * MS)
    if options.silence:
        timers = replace(timers, silence=int(options.silence * MS))
    return timers


def _profile(grammar: Grammar, options: Options) -> Profile:
    """What is known of the device before the run. Raises ValueError for what does not fit."""
    allowed = parse_allowed(grammar, options.allow)
    if options.profile:
        return profile_from(grammar, options.profile, allowed)
    return Profile(choices=Choices(allowed=allowed))


def estimated(target: Target, options: Options, cases: Sequence[AnyCase]) -> float:
    """About how long (s) a run of the cases takes at a target, with what comes before them.

    It counts how long its adapter holds bytes back and how long its probe takes for a look. Cases
    for which such a line leaves no time in the run's budget are not run.
    """
    pace = pace_of(target, options.truncation_timeout)
    spent = sum(seconds(target.protocol, case, pace) for case in cases)
    whole = _timers(target, options).run_budget
    if whole is not None and is_slow(max(pace.answer, pace.look)):
        spent = min(spent, whole / 1e9)
    return before_the_cases(pace) + spent


def pace_of(target: Target, truncation_timeout: float | None = None) -> Pace:
    """How fast a target's line and probe are, as far as that is known; the time-out is in ms."""
    sees, timing = target.environment.observability, target.protocol.timing
    return Pace(
        (truncation_timeout or timing.truncation_timeout) / 1000,
        target.byte_time / 1e9,
        target.latency / 1e9,
        target.look_time / 1e9 if sees.available else 0.0,
        sees.costly or not sees.available,
    )
