"""Runs the suite, for Python: on a device object in virtual time, or on an open port."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Protocol

from analyzer.grammar_file import load_protocol
from analyzer.line_settings import LineSettings
from analyzer.link_errors import LinkError
from analyzer.port import Port
from conformance.cases import Case, all_cases
from conformance.drive import Device, Link, Tap, VirtualLink, drive
from conformance.judging import MS
from conformance.opening import opening_cases, truncation_timeout
from conformance.port_link import PortLink
from conformance.probes import Probe
from conformance.report import Report, make_report
from conformance.run import Eyes, Limits, Run
from conformance.runner import Runner
from conformance.simulator import Simulator
from conformance.verdicts import CaseResult
from spec.protocol import Protocol as Grammar

# How much later than an answer a stop may be seen on a real line although it was in time: link and
# probe are two lines, and a busy machine is late itself.
_GRACE = 20 * MS
_WASTE = 90_000 * MS


@dataclass(frozen=True, slots=True)
class Options:
    """What a run may be told; times in milliseconds, None where the grammar's or the kit's holds.

    `only` are globs of case ids in which * crosses /; none means all. `seed` governs how data and
    motions rotate through the cases. `strict` counts non-strict as failed, `fail_fast` ends the run
    after the first failure. `deadline` is how soon an answer is due, `silence` how long the line is
    listened to after one, `truncation_timeout` the pause that ends a frame (measured if None).
    """

    only: tuple[str, ...] = ()
    seed: int = 1
    strict: bool = False
    fail_fast: bool = False
    deadline: float | None = None
    silence: float | None = None
    truncation_timeout: float | None = None


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


def select_cases(grammar: Grammar, options: Options, *, every_cut: bool) -> tuple[Case, ...]:
    """The cases of a run, besides those that open every run.

    Raises ValueError when `only` leaves none, and names none of the opening ones either.
    """
    cases = all_cases(grammar, options.seed, every_cut=every_cut)
    if not options.only:
        return cases
    chosen = tuple(c for c in cases if _wanted(c, options))
    if not chosen and not any(_wanted(c, options) for c in opening_cases(grammar)):
        raise ValueError(
            f"no case matches {' or '.join(options.only)}; see the ids with --list, for example "
            f"--only '{cases[0].kind}/*'"
        )
    return chosen


def _wanted(case: Case, options: Options) -> bool:
    return any(fnmatchcase(case.id, glob) for glob in options.only)


def conform(
    device: Device | None = None,
    *,
    grammar: Grammar | None = None,
    options: Options | None = None,
    watcher: Watcher | None = None,
    tap: Tap | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    name: str = "sim",
    fault: str | None = None,
) -> Report:
    """Run every case on a device object in virtual time: no waiting, the same result every time.

    `device` is anything with the four methods of `conformance.drive.Device` (times in ns), the
    kit's own simulator if None; one without `look` is judged by its answers alone. `name` and
    `fault` only say in the report what it was. Raises ValueError when no case is left to run.
    """
    grammar = grammar or load_protocol()
    options = options or Options()
    device = device or Simulator(grammar)
    line = grammar.line
    settings = LineSettings(line.baud, line.parity, line.stopbits)
    link = VirtualLink(device, settings.byte_time, tap)
    eyes = Eyes(hasattr(device, "look"), why="the device object has no look")
    return _run(
        link,
        select_cases(grammar, options, every_cut=True),
        Limits(longest=_longest(grammar)),
        eyes,
        grammar=grammar,
        options=options,
        watcher=watcher,
        interrupted=interrupted,
        name=name,
        about={
            "kind": "virtual",
            "line": str(settings),
            "probe": "sim" if eyes.open else "none",
            "fault": fault,
        },
        power=hasattr(device, "power_cycle"),
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
    power: str | None = None,
) -> Report:
    """Run the cases on an open port in real time; the robot moves.

    `stop` is a descriptor that is readable once the user wants to stop, `interrupted` says whether
    that is so. `power` is a shell command that switches the robot off and on. Raises ValueError
    when no case is left to run.
    """
    if probe is None:
        eyes = Eyes(open=False)
    else:
        eyes = Eyes(True, probe.sparse, f"{probe_name} is asked only about a few cases")
    try:
        return _run(
            PortLink(port, probe, stop, tap, power),
            select_cases(grammar, options, every_cut=False),
            Limits(longest=_longest(grammar), grace=_GRACE, settle=2 * MS, waste=_WASTE),
            eyes,
            grammar=grammar,
            options=options,
            watcher=watcher,
            interrupted=interrupted,
            name=port.name,
            about={"kind": "port", "line": str(port.settings), "probe": probe_name},
            power=power is not None,
        )
    except BaseException:
        # A fault of the kit itself must not leave the robot driving.
        with contextlib.suppress(LinkError):
            port.write(bytes([grammar.filler]) * grammar.longest_frame)
        raise


def _longest(grammar: Grammar) -> int:
    """How long an answer is waited for: what is later than allowed must still be heard."""
    return int(grammar.timing.answer_longest * MS)


def _run(
    link: Link,
    cases: Sequence[Case],
    limits: Limits,
    eyes: Eyes,
    *,
    grammar: Grammar,
    options: Options,
    watcher: Watcher | None,
    interrupted: Callable[[], bool | str],
    name: str,
    about: dict[str, Any],
    power: bool,
) -> Report:
    watcher = watcher or Unwatched()
    deadline = options.deadline or grammar.timing.answer_deadline
    limits = replace(limits, deadline=int(deadline * MS))
    if options.silence:
        limits = replace(limits, silence=int(options.silence * MS))
    timeout = options.truncation_timeout
    books = Run(
        grammar,
        limits,
        eyes,
        begin=watcher.begin,
        report=watcher.end,
        truncation_timeout=None if timeout is None else int(timeout * MS),
        power=power,
    )
    timeout_case = truncation_timeout(grammar)
    asked = bool(options.only and timeout_case and _wanted(timeout_case, options))
    runner = Runner(books, cases, fail_fast=options.fail_fast, measure=asked)
    drive(runner.run(), link, interrupted)
    ended = runner.ended
    return make_report(
        grammar,
        books.results,
        cases,
        books.profile,
        device=name,
        link=about,
        options=asdict(options),
        seed=options.seed,
        unusable=runner.unusable,
        ended=str(ended) if ended else "",
        error=bool(ended and ended.error),
        interrupted=bool(ended and not ended.error),
    )


def estimated_seconds(grammar: Grammar, cases: Sequence[Case], options: Options) -> float:
    """About how long the cases take on a port, in s: the silences they wait for, and exchanges."""
    silence = (options.silence or Limits().silence / MS) / 1000
    timeout = (options.truncation_timeout or grammar.timing.truncation_timeout) / 1000
    hold = Limits().hold / 1e9
    total = 0.0
    for case in cases:
        total += 0.008
        if case.stop:
            total += hold if case.thorough else silence
        if case.arrived is not None:
            total += timeout
    return total
