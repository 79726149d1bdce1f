"""Runs the suite, for Python: on a device object in virtual time, or on an open port."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Protocol

from analyzer.grammar_file import load_protocol
from analyzer.transport.errors import LinkError
from analyzer.transport.line_settings import LineSettings
from analyzer.transport.port import Port
from conformance.cases.budget import dropped, within
from conformance.cases.duration import before_the_cases, seconds
from conformance.cases.levels import LEVELS, AnyCase, level_cases
from conformance.cases.opening import opening_cases, truncation_timeout
from conformance.cases.selection import BY_THEMSELVES, matching, share
from conformance.cases.single_frames import Case
from conformance.dut.checked_device import CheckedDevice
from conformance.dut.link import Device, Link, Tap, VirtualLink, drive
from conformance.dut.port_link import PortLink
from conformance.dut.power import Power
from conformance.dut.probes import Probe
from conformance.dut.simulator import Simulator
from conformance.oracle.choices import Choices, parse_allowed
from conformance.oracle.judge import MS
from conformance.oracle.profile import Profile
from conformance.oracle.profile_file import profile_from
from conformance.oracle.timers import Eyes
from conformance.oracle.verdicts import CaseResult
from conformance.report.run_report import Report, make_report
from conformance.runner.discovery.discover import reading_cases
from conformance.runner.environment import Circumstances
from conformance.runner.executor import Runner, Spare
from conformance.runner.listeners.journal import Journal, journalled
from conformance.runner.listeners.meter import Meter
from conformance.runner.listeners.wire_log import WireLog
from conformance.runner.run import Run
from spec.protocol import Protocol as Grammar


@dataclass(frozen=True, slots=True)
class Options:
    """What a run may be told; times in milliseconds, None where the grammar's or the kit's holds.

    `only` are globs of case ids in which * crosses /; none means all. `seed` governs how data and
    motions rotate through the cases. `strict` counts non-strict as failed, `fail_fast` ends the run
    after the first failure. `deadline` is how soon an answer is due, `silence` how long the line is
    listened to after one, `truncation_timeout` the pause that ends a frame (measured if None).
    `shard` (I, N) runs the I-th of N shares of the cases.
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


class Watcher(Protocol):
    """Is told how a run goes."""

    def begin(self, ident: str) -> None:
        """A case begins."""

    def end(self, result: CaseResult) -> None:
        """A case is final."""


class Unwatched:
    """Nobody watches."""

    def begin(self, ident: str) -> None:
        """A case begins."""

    def end(self, result: CaseResult) -> None:
        """A case is final."""


def select_cases(grammar: Grammar, options: Options) -> tuple[AnyCase, ...]:
    """The cases of a run, besides those that open every run.

    Raises ValueError when `only` leaves none, and names none of the opening ones either, and for a
    shard that there is not.
    """
    cases = level_cases(grammar, options.level, options.seed, options.soak)
    if options.only:
        wanted = matching(options.only)
        chosen = tuple(case for case in cases if wanted(case.id))
        if not chosen and not any(wanted(case.id) for case in always(grammar)):
            raise ValueError(
                f"no case matches {' or '.join(options.only)}; see the ids with --list, for "
                f"example --only '{cases[0].id.split('/')[0]}/*'"
            )
        cases = chosen
    if options.budget is not None:
        left = options.budget - before_the_cases(grammar.timing.truncation_timeout / 1000)
        cases = within(grammar, cases, left, lambda c: estimated_seconds(grammar, [c], options))
    if options.shard is None:
        return cases
    return share(cases, options.shard, lambda case: estimated_seconds(grammar, [case], options))


def always(grammar: Grammar) -> tuple[Case, ...]:
    """The cases that every run has: the opening, and the probes of the device's choices."""
    return (*opening_cases(grammar), *reading_cases(grammar))


def suite_ids(grammar: Grammar, options: Options) -> tuple[str, ...]:
    """The ids of every case that a run has with these options if nothing is left out."""
    whole = replace(options, only=(), shard=None)
    cases = (*always(grammar), *select_cases(grammar, whole))
    return (*(case.id for case in cases), *BY_THEMSELVES)


def conform(
    device: Device | None = None,
    *,
    grammar: Grammar | None = None,
    options: Options | None = None,
    watcher: Watcher | None = None,
    tap: Tap | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    name: str = "sim",
    probe: str = "sim",
    fault: str | None = None,
    spare: Spare | None = None,
    logged: bool = True,
) -> Report:
    """Run every case on a device object in virtual time: no waiting, the same result every time.

    `device` is anything with the four methods of `conformance.drive.Device` (times in ns), the
    kit's own simulator if None; one without `look` is judged by its answers alone. `name`,
    `probe` and `fault` only say in the report what it was and what saw it. `spare` is asked before
    each case, with its id and the results so far, whether to skip it. Without `logged` no case
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
    eyes = Eyes(hasattr(device, "look"), why="the device object has no look")
    about = {
        "kind": "virtual",
        "line": str(settings),
        "probe": probe if eyes.open else "none",
        "fault": fault,
    }
    return run_on(
        link,
        Circumstances(True, eyes, hasattr(device, "power_cycle"), name, about),
        grammar=grammar,
        options=options,
        watcher=watcher,
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
    watcher: Watcher | None = None,
    tap: Tap | None = None,
    power: Power | None = None,
    name: str | None = None,
) -> Report:
    """Run the cases on an open port in real time; the robot moves.

    `stop` is a descriptor that is readable once the user wants to stop, `interrupted` says whether
    that is so. `power` switches the robot off and on. `name` says in the report what the device is,
    the port's own name unless given. Raises ValueError when no case is left to run.
    """
    if probe is None:
        eyes = Eyes(open=False)
    else:
        eyes = Eyes(True, probe.sparse, f"{probe_name} is asked only about a few cases")
    about = {
        "kind": "port",
        "line": str(port.settings),
        "baud": port.settings.baud,
        "probe": probe_name,
    }
    try:
        return run_on(
            PortLink(port, probe, stop, tap, power),
            Circumstances(False, eyes, power is not None, name or port.name, about),
            grammar=grammar,
            options=options,
            watcher=watcher,
            interrupted=interrupted,
            tap=tap,
        )
    except BaseException:
        # A fault of the kit itself must not leave the robot driving.
        with contextlib.suppress(LinkError):
            port.write(bytes([grammar.filler]) * grammar.longest_frame)
        raise


def run_on(
    link: Link,
    circumstances: Circumstances,
    *,
    grammar: Grammar,
    options: Options,
    watcher: Watcher | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    tap: Tap | None = None,
    spare: Spare | None = None,
    logged: bool = True,
) -> Report:
    """Run the cases over a link, live or recorded: every run is made here.

    Raises ValueError when no case is left to run.
    """
    cases = select_cases(grammar, options)
    journal = tap if isinstance(tap, Journal) else None
    if journal:
        journal.begins(grammar, options, circumstances)
        link, interrupted = journalled(link, interrupted, journal)
    log = WireLog()
    line = grammar.line
    baud = circumstances.link.get("baud", line.baud)
    meter = Meter(LineSettings(baud, line.parity, line.stopbits).byte_time)
    link = meter.over(log.over(link) if logged else link)
    watcher = watcher or Unwatched()
    limits = circumstances.limits(grammar)
    deadline = options.deadline or grammar.timing.answer_deadline
    limits = replace(limits, deadline=int(deadline * MS), idle=LEVELS[options.level].idle * MS)
    if options.budget is not None and limits.whole is not None:
        limits = replace(limits, whole=int(options.budget * 1e9))
    if options.silence:
        limits = replace(limits, silence=int(options.silence * MS))
    timeout = options.truncation_timeout
    allowed = parse_allowed(grammar, options.allow)
    profile = Profile(choices=Choices(allowed=allowed))
    if options.profile:
        profile = profile_from(grammar, options.profile, allowed)

    def begin(ident: str) -> None:
        if logged:
            log.begin(ident)
        watcher.begin(ident)

    books = Run(
        grammar,
        limits,
        circumstances.eyes,
        begin=begin,
        report=lambda result: watcher.end(log.attached(result)),
        truncation_timeout=None if timeout is None else int(timeout * MS),
        power=circumstances.power,
        profile=profile,
    )
    timeout_case = truncation_timeout(grammar)
    asked = timeout_case is not None and matching(options.only)(timeout_case.id)
    runner = Runner(
        books,
        cases,
        fail_fast=options.fail_fast,
        measure=asked,
        discover=not options.profile,
        spare=spare,
    )
    drive(runner.run(), link, interrupted)
    ended = runner.ended
    report = make_report(
        grammar,
        [log.attached(result) for result in books.results],
        cases,
        books.profile,
        device=circumstances.device,
        link=circumstances.link,
        options=asdict(options),
        seed=options.seed,
        unusable=runner.unusable,
        ended=str(ended) if ended else "",
        timing=meter.report(books.timeouts),
        dropped=_dropped(grammar, options, cases),
        error=bool(ended and ended.error),
        interrupted=bool(ended and not ended.error),
    )
    if journal:
        journal.reported(report)
    return report


def _dropped(grammar: Grammar, options: Options, cases: Sequence[AnyCase]) -> dict[str, int]:
    """How many cases of each group the budget has left out."""
    if options.budget is None:
        return {}
    return dropped(select_cases(grammar, replace(options, budget=None, shard=None)), cases)


def estimated_seconds(grammar: Grammar, cases: Sequence[AnyCase], options: Options) -> float:
    """About how long the cases take on a port, in s: the wire, silences and time-outs, looks."""
    timeout = (options.truncation_timeout or grammar.timing.truncation_timeout) / 1000
    line = LineSettings(grammar.line.baud, grammar.line.parity, grammar.line.stopbits)
    byte_time = line.byte_time / 1e9
    return sum(seconds(grammar, case, byte_time, timeout) for case in cases)
