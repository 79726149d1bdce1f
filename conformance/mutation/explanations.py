"""Scores the causes: whether those of a faulty device's failures name what was planted in it."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product

import msgspec

from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.causes.causes import Cause
from bilprov.conformance.causes.exchanges import Exchange, Exchanges
from bilprov.conformance.causes.explained import Explainer
from bilprov.conformance.causes.reproduction import exchanged, shown_in
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.conformance.mutation.effects import then
from bilprov.conformance.mutation.faults import MIXTURE, hooks_of
from bilprov.conformance.mutation.score import workers, working
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.run import Run
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

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
        state, made = acted.get(_over(exchange, exchanges), (None, False))
        if state is not None and _alike(state, exchange.before):
            deviates = made != (usual is not None and _chosen(usual, exchange))
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


def _over(exchange: Exchange, exchanges: Exchanges) -> int:
    """When a device takes a frame for over (ns)."""
    return exchange.end + (exchanges.timing.timeout if exchange.step.truncated else 0)


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
        for result in each(_task, tasks):
            progress(result.name)
            found.append(result)
    return CauseScore(tuple(found[: len(names)]), tuple(found[len(names) :]))


def _task(task: tuple[tuple[str, ...], str]) -> Explained:
    protocol, seed, _ = working()
    return explained(protocol, *task, seed)
