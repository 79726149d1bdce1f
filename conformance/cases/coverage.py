"""Coverage of a run: which frames, pairs, states and deliveries its cases exercise, of how many.

Coverage is counted in facts; a fact is a pair (what is counted, the item). A sequence's facts come
from the model with the kit's own readings. The totals leave out what cannot be reached (no motion
goes on after a stop).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import chain, combinations

from bilprov.conformance.cases.case import state_after
from bilprov.conformance.cases.combinations import (
    ARRAY,
    PIPELINED,
    SPLIT,
    STRENGTH,
    WAITED,
    Row,
    space_of,
    total,
)
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.sequence import DELIVERIES, Burst, SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Step, kind_of, one_of_each
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

Fact = tuple[str, object]

HEADERS = "headers"
VALID = "valid frames"
BAD = "bad data"
CUTS = "truncations"
STATES = "instructions and faults x kinds of motion"
PAIRS = "pairs in a row"
TRIPLES = "pairs in a row x kinds of motion"
WAYS = "instructions and faults x deliveries"
COMBINED = {2: "combinations of two", STRENGTH: "combinations of three"}


def facts(protocol: Protocol, case: AnyCase) -> Iterator[Fact]:
    """The facts that a case exercises."""
    if isinstance(case, SequenceCase):
        yield from _run(protocol, case)
        return
    yield from _sent(case, kind_of(protocol, case))
    yield from _met(kind_of(protocol, case), visible_motion(case.setup), "waited")


def _sent(step: Step, kind: str) -> Iterator[Fact]:
    """The facts of a frame by itself."""
    yield HEADERS, step.frame[0]
    if step.truncated:
        yield CUTS, (step.frame[0], len(step.frame) - 1)
    elif not step.faulty:
        yield VALID, step.frame
    elif kind == FrameClass.BAD_DATA:
        yield BAD, step.frame


def _met(kind: str, motion: str, way: str) -> Iterator[Fact]:
    """The facts of a kind of frame in a motion and a delivery."""
    yield STATES, (kind, motion)
    if kind != FrameClass.TRUNCATED and way != "cut":
        yield WAYS, (kind, way)


def _run(protocol: Protocol, sequence: SequenceCase) -> Iterator[Fact]:
    sent: dict[bytes, tuple[Step, str]] = {}
    met: set[tuple[str, str, str, str]] = set()
    last = ""
    for place, (burst, _, step, state, _) in enumerate(_walk(protocol, sequence)):
        kind = kind_of(protocol, step)
        if place >= len(sequence.setup):
            sent[step.frame] = step, kind
            met.add((last, kind, visible_motion(state), burst.delivery))
        last = kind
    for step, kind in sent.values():
        yield from _sent(step, kind)
    for before, kind, motion, way in met:
        yield from _met(kind, motion, way)
        if before:
            yield PAIRS, (before, kind)
            yield TRIPLES, (before, kind, motion)


def _walk(
    protocol: Protocol, sequence: SequenceCase
) -> Iterator[tuple[Burst, int, Step, State, Step | None]]:
    """Each step with its burst and how many of that follow it, the state and the step before it."""
    state, before = protocol.power_on, None
    for burst in (*(Burst((step,)) for step in sequence.setup), *sequence.bursts):
        for left, step in zip(reversed(range(len(burst.steps))), burst.steps, strict=True):
            yield burst, left, step, state, before
            state, before = state_after(protocol, state, step), step


@lru_cache(maxsize=4)
def totals(protocol: Protocol) -> dict[str, int]:
    """How many facts of each kind there are."""
    lengths, specs = protocol.lengths, protocol.instructions
    motions = (protocol.car.still, *moving_motions(protocol))
    # Every protocol can truncate a frame, if only one with an unused ID.
    faults = len({FrameClass.TRUNCATED, *one_of_each(protocol)})
    kinds = len(specs) + faults
    # After a motion the robot moves so, or stands still (speed 0); a setting leaves any motion on.
    reached = (
        sum(
            2 if protocol.car.moves(s.effect) else 1 if protocol.stops(s.effect) else len(motions)
            for s in specs
        )
        + faults
    )
    return {
        HEADERS: len(protocol.headers),
        # These totals hold every value; where data are wide, a level sends only a sample of them.
        VALID: sum(spec.valid_count for spec in specs),
        BAD: sum(spec.bad_data_count for spec in specs),
        CUTS: sum(lengths),
        STATES: kinds * len(motions),
        PAIRS: kinds * kinds,
        TRIPLES: reached * kinds,
        # A truncated frame has one delivery: its end cannot come in pieces or be waited for.
        WAYS: (kinds - 1) * len(DELIVERIES),
    }


def covered(protocol: Protocol, cases: Iterable[AnyCase]) -> dict[str, tuple[int, int]]:
    """How many facts these cases exercise, out of how many: (done, of) by what is counted."""
    cases, of = list(cases), totals(protocol)
    met: set[Fact] = set()
    for case in cases:
        met.update(facts(protocol, case))
    done = Counter(name for name, _ in met)
    found = {name: (done[name], of[name]) for name in of if of[name]}
    combined = [
        case for case in cases if isinstance(case, SequenceCase) and case.id.startswith(f"{ARRAY}/")
    ]
    return found | _combined(protocol, combined) if combined else found


def _combined(protocol: Protocol, cases: Iterable[SequenceCase]) -> dict[str, tuple[int, int]]:
    """How many combinations of two and of three factors these cases exercise, out of how many.

    Of each burst the last frame counts, after which the robot is observed; truncated frames do not.
    """
    met: dict[int, set[tuple[int, ...]]] = {strength: set() for strength in COMBINED}
    of = {strength: total(protocol, strength) for strength in COMBINED}
    seen: set[Row] = set()
    for row in _rows(protocol, cases):
        if all(len(met[strength]) == of[strength] for strength in COMBINED):
            break
        if row in seen:
            continue
        seen.add(row)
        for strength, found in met.items():
            if len(found) < of[strength]:
                # A number stands for a factor and its value.
                values = [factor << 16 | value for factor, value in enumerate(row)]
                found.update(combinations(values, strength))
    return {name: (len(met[strength]), of[strength]) for strength, name in COMBINED.items()}


def _rows(protocol: Protocol, cases: Iterable[SequenceCase]) -> Iterator[Row]:
    """The rows of the frames after which these cases observe the robot."""
    space = space_of(protocol)
    for burst, left, step, state, before in chain.from_iterable(_walk(protocol, c) for c in cases):
        if burst.looks and not left and not step.truncated:
            way = SPLIT if burst.pauses else PIPELINED if len(burst.steps) > 1 else WAITED
            fault = kind_of(protocol, before) if before and before.faulty else ""
            row = space.row(state, fault, step, way)
            if row:
                yield row
