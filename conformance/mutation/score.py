"""Scores the suite: which faulty devices it catches, by which cases, and what it says of causes.

The suite runs in virtual time, in this process or in several. Every value that is shown comes from
`Score`.
"""

from __future__ import annotations

import multiprocessing
import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import product
from typing import TYPE_CHECKING, TypeVar

import msgspec

from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.causes.exchanges import Exchange, Exchanges
from bilprov.conformance.causes.explained import Explainer
from bilprov.conformance.causes.reproduction import exchanged, shown_in
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.dut.simulator import CONFORMING, Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.catalogue import PREFIX, find_fault
from bilprov.conformance.mutation.effects import then
from bilprov.conformance.mutation.faults import MIXTURE, fault_bank, hooks_of, mixtures
from bilprov.conformance.mutation.search import MOST, Search, search
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.conformance.oracle.verdicts import LABELS, VOUCHED, CaseResult, Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.run import Run
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

if TYPE_CHECKING:
    from bilprov.conformance.causes.causes import Cause

RANDOM_FLOOR = 0.9  # share of the random faults that can show which must be caught
FLOORS = {"smoke": 0.88}  # share of the named faults by level; at any other level all of them
REFERENCE = CONFORMING.name
A = TypeVar("A")
B = TypeVar("B")
Task = tuple[str, str]  # a fault's name and a level


class Caught(msgspec.Struct, frozen=True):
    """Result of running the suite at one level against one faulty device.

    `groups` are the case groups that failed: the only one, or the first of several. `own_clause`
    is true unless cases failed of which none names a clause that the fault breaks. `verdict` is
    the worst verdict of the run, `sent` the number of bytes sent until the remaining cases could
    be skipped.
    """

    name: str
    level: str
    caught: bool
    verdict: str
    groups: tuple[str, ...]
    own_clause: bool
    sent: int

    @property
    def passed(self) -> bool:
        """Whether the run vouches for the device, perhaps with remarks."""
        return LABELS[self.verdict] in VOUCHED


class Score(msgspec.Struct, frozen=True):
    """Mutation score of the suite.

    `levels` are the levels that ran, `bytes` the bytes sent to the reference device at each,
    `faults` the (family, sentence) of each fault by name, `soak` the faults that only a soak shows,
    `results` one value for each device and level, `reference` the verdict of the conforming device
    at each level. `searches` holds the search for each fault that the last level did not catch. The
    last four count the random faults at the last level: `told_apart` are those that failed and
    those that a search shows to differ from the reference, and of these `failed` do, `passed` do
    not, and the others are `inconclusive`.
    """

    levels: tuple[str, ...]
    bytes: dict[str, int]
    faults: dict[str, tuple[str, str]]
    soak: tuple[str, ...]
    results: tuple[Caught, ...]
    reference: dict[str, str]
    searches: dict[str, Search]
    told_apart: int = 0
    failed: int = 0
    passed: int = 0
    inconclusive: int = 0

    def at(self, level: str) -> dict[str, Caught]:
        """Return the results of one level by the fault's name."""
        return {result.name: result for result in self.results if result.level == level}

    @property
    def families(self) -> tuple[str, ...]:
        """The fault families, in the order of the bank."""
        return tuple(dict.fromkeys(family for family, _ in self.faults.values()))

    def caught(self, family: str, level: str) -> tuple[int, int]:
        """Return how many faults of a family are caught at a level, of how many that can show."""
        found = [
            result
            for name, result in self.at(level).items()
            if self.faults[name][0] == family and self.can_show(name)
        ]
        return sum(result.caught for result in found), len(found)

    def survivors(self, level: str) -> list[str]:
        """Return the faults that a level does not catch, except those that only a soak shows."""
        return [n for n, r in self.at(level).items() if not r.caught and n not in self.soak]

    def can_show(self, name: str) -> bool:
        """Return whether some run could catch the fault: not for a random one no search shows."""
        found = self.searches.get(name)
        return found is None or not is_random(name) or bool(found.shown)

    def share(self, level: str, *, drawn: bool) -> tuple[int, int]:
        """Return how many named (`drawn`: random) faults are caught, of how many that can show."""
        found = [
            result
            for name, result in self.at(level).items()
            if is_random(name) is drawn and name not in self.soak and self.can_show(name)
        ]
        return sum(result.caught for result in found), len(found)

    @property
    def failures(self) -> list[str]:
        """One sentence for each promise of the suite that is not kept: verdict, floor or clause."""
        found = [
            f"{level}: the reference device gets {verdict}"
            for level, verdict in self.reference.items()
            if verdict != Verdict.PASS.label
        ]
        for level in self.levels:
            for drawn, floor in ((False, FLOORS.get(level, 1.0)), (True, RANDOM_FLOOR)):
                caught, of = self.share(level, drawn=drawn)
                what = "random" if drawn else "named"
                if caught < floor * of and not (drawn and level in FLOORS):
                    found.append(f"{level}: {caught} of {of} {what} faults, {floor:.0%} must be")
            for name, result in self.at(level).items():
                if not result.own_clause:
                    found.append(f"{level}: no case that fails for {name} names its clause")
        return found

    def alone(self, level: str) -> dict[str, list[str]]:
        """Return, for each case group, the faults that no other group catches."""
        found: dict[str, list[str]] = {}
        for name, result in self.at(level).items():
            for group in result.groups:
                found.setdefault(group, [])
            if len(result.groups) == 1:
                found[result.groups[0]].append(name)
        return found


def is_random(name: str) -> bool:
    """Return whether the name is that of a random fault."""
    return name.startswith(PREFIX)


def group_of(ident: str) -> str:
    """Return a case's group: the class of a single frame, else the first two parts of the id."""
    first, _, rest = ident.partition("/")
    if first in set(FrameClass) or not rest:
        return first
    return f"{first}/{rest.split('/')[0]}" if "/" in rest else first


def chosen_faults(
    protocol: Protocol, drawn: int, only: Sequence[str] = (), fault_seed: int | None = None
) -> dict[str, tuple[str, str]]:
    """Return the faults to score by name: the bank, the mixtures and `drawn` random ones.

    With a `fault_seed` it is `drawn` random ones of that seed alone. `only` are globs of names;
    none means all. Values are (family, sentence).
    """
    if fault_seed is None:
        named = (*fault_bank(protocol).values(), *mixtures(protocol).values())
        names = [fault.name for fault in named] + [f"{PREFIX}{n}" for n in range(1, drawn + 1)]
    else:
        names = [f"{PREFIX}{fault_seed}.{n}" for n in range(1, drawn + 1)]
    wanted = [n for n in names if not only or any(fnmatchcase(n, glob) for glob in only)]
    faults = [find_fault(protocol, name) for name in wanted]
    return {fault.name: (fault.family, fault.doc) for fault in faults}


def score(
    protocol: Protocol,
    faults: dict[str, tuple[str, str]],
    *,
    at: Sequence[str] = (),
    seed: int = 1,
    jobs: int = 1,
    most: int = MOST,
    progress: Callable[[str], None] = lambda name: None,
) -> Score:
    """Run the suite against every fault of `faults` (name -> family and sentence).

    `at` are levels (the default level if none), `seed` is the suite's seed, `jobs` the number of
    processes. For each fault that the last level does not catch there is a search, each part of
    which tries at most `most` inputs. `progress` is called with the name of each fault that is
    done.
    """
    chosen = tuple(at) or (Options().level,)
    results, cost, reference = [], {}, {}
    for level in chosen:
        told = _try(protocol, (REFERENCE, level), seed)
        cost[level], reference[level] = told.sent, told.verdict
    soak = tuple(n for n in faults if find_fault(protocol, n).needs == "soak")
    with workers(protocol, seed, most, jobs) as each:
        for result in each(_task, [(name, level) for level in chosen for name in faults]):
            progress(result.name)
            results.append(result)
        found = Score(chosen, cost, faults, soak, tuple(results), reference, {})
        searches = {}
        for name, result_of in each(_search_for, found.survivors(chosen[-1])):
            progress(name)
            searches[name] = result_of
    return _counted(msgspec.structs.replace(found, searches=searches))


def _counted(found: Score) -> Score:
    """Return the score with its counts of random faults at the last level."""
    last = found.levels[-1]
    failed, of = found.share(last, drawn=True)
    passed = sum(
        is_random(name) and found.can_show(name) and found.at(last)[name].passed
        for name in found.survivors(last)
    )
    return msgspec.structs.replace(
        found, failed=failed, told_apart=of, passed=passed, inconclusive=of - failed - passed
    )


_worker: tuple[Protocol, int, int] | None = None


def _begin(protocol: Protocol, seed: int, most: int) -> None:
    global _worker
    _worker = (protocol, seed, most)


def working() -> tuple[Protocol, int, int]:
    """Return what `workers` has given this process: the protocol, the suite's seed, and `most`."""
    assert _worker is not None
    return _worker


def _task(task: Task) -> Caught:
    protocol, seed, _ = working()
    return _try(protocol, task, seed)


def _search_for(name: str) -> tuple[str, Search]:
    protocol, _, most = working()
    return name, search(protocol, find_fault(protocol, name), most)


@contextmanager
def workers(
    protocol: Protocol, seed: int, most: int, jobs: int
) -> Iterator[Callable[[Callable[[A], B], Sequence[A]], Iterable[B]]]:
    """Yield a `map` that runs on `jobs` processes, or in this process if `jobs` is 1."""
    if jobs == 1:
        _begin(protocol, seed, most)
        yield map
        return
    # spawned, not forked: the same on every system, and safe beside threads
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _begin, (protocol, seed, most)) as pool:
        yield pool.map


class _Spares:
    """Skip policy: skips the rest of a case group that failed, and every case once two failed.

    It is then known whether one group alone catches the fault. `wanted` are the clauses that the
    fault breaks: nothing is skipped until a failed case names one of them.
    """

    def __init__(self, wanted: set[str]) -> None:
        self._wanted = wanted
        self._read = 0
        self._failed: set[str] = set()
        self._named = False

    def __call__(self, ident: str, results: Sequence[CaseResult]) -> bool:
        for result in results[self._read :]:
            if result.verdict is Verdict.FAIL:
                self._failed.add(group_of(result.id))
                self._named = self._named or result.clause in self._wanted
        self._read = len(results)
        return (len(self._failed) > 1 and self._named) or (
            self._named and group_of(ident) in self._failed
        )


def _try(protocol: Protocol, task: Task, seed: int) -> Caught:
    name, level = task
    fault = CONFORMING if name == REFERENCE else find_fault(protocol, name)
    broken = {getattr(protocol.clauses, clause) for clause in fault.clauses}
    report = run_suite(
        device_target(protocol, Simulator(protocol, fault)),
        Options(seed=seed, level=level),
        skip=_Spares(broken),
        logged=False,
    )
    failed = [result for result in report.results if result.verdict is Verdict.FAIL]
    return Caught(
        name=name,
        level=level,
        caught=report.exit == fault.exit,  # 2 for a dead line, 3 for no motion, else 1
        verdict=report.verdict.label,
        groups=tuple(Counter(group_of(result.id) for result in failed)),
        own_clause=not failed or bool(broken & {result.clause for result in failed}),
        sent=int(report.timing["bytes_sent"]),
    )


# -- the score of the causes: whether they name what was planted in a faulty device ---------------


DIFFERENT = 0.05
"""Share of the frames sent at which a cause may expect something else than the fault does."""
_FIRST = 3
"""Causes that somebody reads first: both faults of a pair should be among them."""


class Explained(msgspec.Struct, frozen=True):
    """The causes of one device's failures, of which `failed` are how many.

    `causes` is how many there are, `unexplained` how many failures none explains, `first` the
    sentence of the first. `named` is how many of its faults have a cause among the first ones that
    expects a deviation at the frames where the fault makes one, of `of` of which that is known; a
    fault of how bytes are framed or shown makes none that could be compared. `hidden` is how many
    are not named and change no verdict: without them each case has the same. `shown` is whether
    the first cause's line shows it on a device just switched on.
    """

    name: str
    failed: int
    causes: int = 0
    unexplained: int = 0
    first: str = ""
    named: int = 0
    of: int = 0
    hidden: int = 0
    shown: bool = False


class CauseScore(msgspec.Struct, frozen=True):
    """What the causes are worth: results for single faults and for pairs of them."""

    singles: tuple[Explained, ...]
    pairs: tuple[Explained, ...]

    @property
    def failing(self) -> tuple[Explained, ...]:
        """The single faults that failed anything."""
        return tuple(one for one in self.singles if one.failed)

    def sentences(self) -> Iterable[str]:
        """Yield what came out, a sentence for each promise."""
        of = len(self.failing)
        one = sum(found.causes == 1 and found.named == found.of for found in self.failing)
        two = sum(1 <= found.causes <= 2 for found in self.failing)
        shown = sum(found.shown for found in self.failing)
        yield f"{one} of {of} faults are exactly one cause, which names the trigger if it is known"
        yield f"{two} of {of} faults are at most two causes"
        yield f"{shown} of {of} first causes show with their line on a device just switched on"
        told = [found for found in self.pairs if found.failed and not found.hidden]
        both = sum(found.named == found.of for found in told)
        if self.pairs:
            yield f"{both} of {len(told)} pairs have both faults among the first {_FIRST} causes"
            apart = len(self.pairs) - len(told)
            yield f"in {apart} other pairs one fault changes no verdict beside the other"


Acted = dict[int, tuple[State, bool]]
"""The state before a frame, and whether a fault changed the reaction to it, by the time (ns)."""


def _marked(fault: Fault) -> tuple[Fault, Acted]:
    """A fault, and when it acted."""
    inner, acted = fault.react, Acted()
    if inner is None:
        return fault, acted

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        changed = inner(device, event, reaction)
        acted[event.now] = event.before, _done(changed) != _done(reaction)
        return changed

    return replace(fault, react=react), acted


def _done(reaction: Reaction) -> Reaction:
    """What a reaction comes to: without the states in it that follow on the same state."""
    states = (reaction.state, *(state for _, state in reaction.later))
    later = (new for new, old in zip(reaction.later, states, strict=False) if new[1] != old)
    return replace(reaction, later=tuple(later))


def explained(protocol: Protocol, names: Sequence[str], level: str, seed: int) -> Explained:
    """Run the suite against the device with these faults (one, or two that fit together)."""
    faults, acting = zip(*(_marked(find_fault(protocol, name)) for name in names), strict=True)
    fault = faults[0] if len(faults) == 1 else both(*faults)
    held: list[Explainer] = []

    def explainer(run: Run, trace: Trace, byte_time: int) -> Explainer:
        held.append(Explainer(run, trace, byte_time))
        return held[0]

    options = Options(seed=seed, level=level)
    target = device_target(protocol, Simulator(protocol, fault))
    report = run_suite(target, options, logged=False, explainer=explainer)
    label, failed = " and ".join(names), report.counts["fail"]
    found = [explanation.found for explanation in held[0].explanations]
    exchanges = held[0].exchanges
    if not found or exchanges is None:
        return Explained(label, failed, unexplained=report.unexplained)
    first = found if len(names) == 1 else found[:_FIRST]
    named, hidden = [], 0
    for name, acted in zip(names, acting, strict=True):
        if not any(made for _, made in acted.values()):
            continue
        named.append(
            any(_names(cause, exchanges, acted, _usual(protocol, name)) for cause in first)
        )
        if not named[-1] and len(names) > 1:
            [other] = {*names} - {name}
            hidden += _same_verdicts(protocol, find_fault(protocol, other), options, report)
    return Explained(
        label,
        failed,
        len(found),
        report.unexplained,
        report.causes[0].sentence,
        sum(named),
        len(named),
        hidden,
        _shows_on(protocol, fault, held[0]),
    )


def _same_verdicts(protocol: Protocol, fault: Fault, options: Options, report: Report) -> bool:
    """Whether each case has the verdict of this report also where the device has that fault."""
    target = device_target(protocol, Simulator(protocol, fault))
    alone = run_suite(target, options, logged=False, explainer=None)
    return _verdicts(alone) == _verdicts(report)


def _verdicts(report: Report) -> dict[str, Verdict]:
    return {result.id: result.verdict for result in report.results}


def _usual(protocol: Protocol, name: str) -> Model | None:
    """The model by which a mixture of two readings was made, None for another fault."""
    return Model(protocol, Choices()) if name.startswith(MIXTURE) else None


def _names(cause: Cause, exchanges: Exchanges, acted: Acted, usual: Model | None) -> bool:
    """Whether a cause expects deviations at the frames at which a fault makes them.

    A mixture, which was made by the `usual` model, makes them where it does not do as the device
    has chosen. Frames before which the device was in another state than expected are not compared.
    """
    compared = []
    for exchange in exchanges.all:
        act = _act(acted, exchange, exchanges)
        if act and _alike(act[0], exchange.before):
            deviates = act[1] != (usual is not None and _chosen(usual, exchange))
            compared.append((cause.foresees(exchange), deviates))
    different = sum(expected != deviates for expected, deviates in compared)
    shared = sum(expected and deviates for expected, deviates in compared)
    return bool(shared) and different <= DIFFERENT * len(compared)


def _alike(state: State, expected: ExpectedState) -> bool:
    """Whether a device is in the expected state, as far as that is known."""
    known = set(state.variables) - expected.unknown
    return all(getattr(state, name) == getattr(expected.state, name) for name in known)


def _chosen(usual: Model, exchange: Exchange) -> bool:
    """Whether the device's own choice of a reading makes another reaction the right one."""
    code = next(iter(exchange.step.accepted[0].codes), None)
    after = usual.after(exchange.before, exchange.step.frame_effect)
    return code not in exchange.accepted or after.state != exchange.after.state


def _act(acted: Acted, exchange: Exchange, exchanges: Exchanges) -> tuple[State, bool] | None:
    """What a device did at a frame, None where that is not known.

    It takes a frame for over at its end, or at its header where it takes the data for others.
    """
    over = exchange.end + (exchanges.timing.timeout if exchange.step.truncated else 0)
    return acted.get(over) or acted.get(exchange.start)


def _shows_on(protocol: Protocol, fault: Fault, explainer: Explainer) -> bool:
    """Whether the first cause's line shows it on a fresh device."""
    first, device = explainer.explanations[0], Simulator(protocol, fault)
    cause, line = first.found, first.lines[0]
    sent = exchanged(line, explainer.timing, explainer.run.model, device, cause.watched)
    return shown_in(cause, line, sent) is not None


def both(one: Fault, other: Fault) -> Fault:
    """Return the device with two faults, the second of which reacts to what the first has made."""
    reacts = [fault.react for fault in (one, other) if fault.react]
    return replace(one, name=f"{one.name} and {other.name}", react=then(*reacts), **hooks_of(other))


def drawn_pairs(
    protocol: Protocol, names: Sequence[str], count: int, seed: int
) -> list[tuple[str, ...]]:
    """Draw pairs of faults of different families which a simulated device can have both.

    Only such as change reactions are drawn: of others it is not known where they show.
    """
    faults = [fault for name in names if (fault := find_fault(protocol, name)).react]
    fitting = [
        (one.name, other.name)
        for one, other in product(faults, faults)
        if one.name < other.name
        and one.family != other.family
        and hooks_of(one).keys().isdisjoint(hooks_of(other))
    ]
    return random.Random(seed).sample(fitting, min(count, len(fitting)))


def cause_score(
    protocol: Protocol,
    names: Sequence[str],
    pairs: int,
    level: str,
    *,
    seed: int = 1,
    jobs: int = 1,
    progress: Callable[[str], None] = lambda name: None,
) -> CauseScore:
    """Score the causes of each of these faults, and of so many pairs of them.

    The options are those of `score`.
    """
    tasks: list[tuple[tuple[str, ...], str]] = [((name,), level) for name in names]
    tasks += [(pair, level) for pair in drawn_pairs(protocol, names, pairs, seed)]
    found = []
    with workers(protocol, seed, 0, jobs) as each:
        for result in each(_cause_task, tasks):
            progress(result.name)
            found.append(result)
    return CauseScore(tuple(found[: len(names)]), tuple(found[len(names) :]))


def _cause_task(task: tuple[tuple[str, ...], str]) -> Explained:
    protocol, seed, _ = working()
    return explained(protocol, *task, seed)
