"""What a run exercised, as facts: which frames, pairs, states and deliveries, out of how many.

A fact is a pair (what is counted, the item). A walk's facts come from the model with the kit's own
readings; the totals leave out what cannot be reached (a motion is over after a stop).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from functools import lru_cache

from conformance.cases.levels import AnyCase
from conformance.cases.preamble import moves
from conformance.cases.sequence import Walk
from conformance.cases.single_frames import moving_motions
from conformance.cases.steps import Class, Step
from spec.codec import all_data, bad_data
from spec.motion import Motion, State
from spec.protocol import Protocol

Fact = tuple[str, object]

HEADERS = "headers"
VALID = "valid frames"
BAD = "bad data"
CUTS = "truncations"
STATES = "instructions and faults x kinds of motion"
PAIRS = "pairs in a row"
TRIPLES = "pairs in a row x kinds of motion"
DELIVERIES = "instructions and faults x deliveries"
_WAYS = ("waited", "pipelined", "split", "left alone")


def kind_of(protocol: Protocol, step: Step) -> str:
    """An instruction's name, or the class of the fault: `too-many` and `too-few` apart."""
    identity, length = protocol.headers[step.frame[0]]
    spec = protocol.by_id.get(identity)
    if not step.faulty and spec is not None:
        return spec.name
    if step.cut:
        return Class.TRUNCATED
    if spec is None:
        return Class.UNUSED_ID
    if length == spec.length:
        return Class.BAD_DATA
    return "too-many" if length > spec.length else "too-few"


def facts(protocol: Protocol, case: AnyCase) -> Iterator[Fact]:
    """What a case exercises."""
    if isinstance(case, Walk):
        yield from _walked(protocol, case)
        return
    yield from _sent(protocol, case.step, case.setup.visible_motion, "waited")


def _sent(protocol: Protocol, step: Step, motion: Motion, way: str) -> Iterator[Fact]:
    kind = kind_of(protocol, step)
    yield HEADERS, step.frame[0]
    yield STATES, (kind, motion)
    if not step.cut and way != "cut":
        yield DELIVERIES, (kind, way)
    if step.cut:
        yield CUTS, (step.frame[0], len(step.frame) - 1)
    elif not step.faulty:
        yield VALID, step.frame
    elif kind == Class.BAD_DATA:
        yield BAD, step.frame


def _walked(protocol: Protocol, walk: Walk) -> Iterator[Fact]:
    state, last = protocol.power_on, ""
    for step in walk.setup:
        state = _after(protocol, state, step)
        last = kind_of(protocol, step)
    for burst in walk.bursts:
        for step in burst.steps:
            kind, motion = kind_of(protocol, step), state.visible_motion
            yield from _sent(protocol, step, motion, burst.delivery)
            if last:
                yield PAIRS, (last, kind)
                yield TRIPLES, (last, kind, motion)
            state, last = _after(protocol, state, step), kind


def _after(protocol: Protocol, state: State, step: Step) -> State:
    return (step.deed.effect or protocol.on_fault).apply(state, step.deed.values)


@lru_cache(maxsize=4)
def totals(protocol: Protocol) -> dict[str, int]:
    """How much there is of what is counted."""
    lengths, specs = protocol.lengths, protocol.instructions
    motions = (Motion.STOPPED, *moving_motions(protocol))
    faults = [Class.TRUNCATED, "too-many"]
    faults += [Class.UNUSED_ID] if protocol.unused_ids else []
    faults += ["too-few"] if any(spec.length for spec in specs) else []
    faults += [Class.BAD_DATA] if any(True for s in specs for _ in bad_data(s)) else []
    kinds = len(specs) + len(faults)
    # After a motion it moves so, or not at all (speed 0); after a setting anything goes on.
    reached = sum(
        2 if moves(s) else 1 if s.effect.motion is Motion.STOPPED else len(motions) for s in specs
    ) + len(faults)
    return {
        HEADERS: len(protocol.headers),
        VALID: sum(len(list(all_data(spec))) for spec in specs),
        BAD: sum(len(list(bad_data(spec))) for spec in specs),
        CUTS: sum(lengths),
        STATES: kinds * len(motions),
        PAIRS: kinds * kinds,
        TRIPLES: reached * kinds,
        # A frame that is cut short has no end that could come in pieces, or be waited for.
        DELIVERIES: (kinds - 1) * len(_WAYS),
    }


def covered(protocol: Protocol, cases: Iterable[AnyCase]) -> dict[str, tuple[int, int]]:
    """How much of what there is these cases exercise: (done, of) by what is counted."""
    of = totals(protocol)
    met: set[Fact] = set()
    for case in cases:
        met.update(facts(protocol, case))
    done = Counter(name for name, _ in met)
    return {name: (done[name], of[name]) for name in of if of[name]}
