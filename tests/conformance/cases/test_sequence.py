"""Sequences: they cover all combinations, use each kind of delivery, and agree with the judge."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise, product

import pytest
from msgspec.structs import replace

from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.cases.levels import (
    CUTS,
    INDEPENDENT_GROUPS,
    SEQUENCE_PREFIXES,
    TRIPLES,
    covered,
    level_cases,
    reaches,
)
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.cases.sweeps import soak
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.codec import judge
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from tests.vectors import READING_IDS

pytestmark = pytest.mark.slow

MOVERS = {
    "Forward": Motion.FORWARD,
    "Backward": Motion.BACKWARD,
    "RotateRight": Motion.ROTATE_RIGHT,
    "RotateLeft": Motion.ROTATE_LEFT,
}
MOVING = set(MOVERS.values())
SETTINGS = {"Speed", "Right", "Left", "LED"}
FAULTS = {"BAD_HEADER", "BAD_DATA", "TOO_MANY_DATA", "TOO_FEW_DATA"}
WHOLE = {"Stop", *MOVERS, *SETTINGS, *FAULTS}
CUT = "cut short"
FILLS = (b"\x00", b"\x20", b"\xff")
# Where a walk may be split: one time-out over the whole frame must not be reached by its pauses.
MOST_PAUSES = 4
# The levels that hold nothing but tours and sweeps; `test_proof` is about the other.
TOURS = ("smoke", "standard", "deep")
# Its cases take seconds to make.
DEEP = pytest.mark.sample(0)


def sequences_of(protocol: Protocol, level: str = "standard", seed: int = 1) -> list[SequenceCase]:
    return [case for case in level_cases(protocol, level, seed) if isinstance(case, SequenceCase)]


def kind_of(protocol: Protocol, step: Step) -> str:
    """What a step is an example of, by the frame alone."""
    judged = judge(protocol, step.frame)
    if judged.truncated:
        return CUT
    return judged.name if judged.valid else judged.response.name


def states(
    protocol: Protocol, sequence: SequenceCase
) -> Iterator[tuple[Burst | None, Step, State]]:
    """Each step of a walk with the state before it, by the judge; the set-up's have no burst."""
    state = protocol.power_on
    parts: list[tuple[Burst | None, Sequence[Step]]] = [(None, sequence.setup)]
    parts += [(burst, burst.steps) for burst in sequence.bursts]
    for burst, steps in parts:
        for step in steps:
            yield burst, step, state
            judged = judge(protocol, step.frame)
            if judged.valid and judged.instruction:
                state = judged.instruction.effect.apply(state, dict(judged.fields))
            else:
                state = protocol.on_fault.apply(state)


# -- nothing is left out --------------------------------------------------------------------------


def swept(protocol: Protocol, what: str) -> Counter[tuple[bytes, Motion]]:
    """How often each frame that is swept was sent in each kind of motion; speed 0 is one of them.

    Elsewhere the robot moves.
    """
    met: Counter[tuple[bytes, Motion]] = Counter()
    for sequence in sequences_of(protocol):
        if sequence.id.startswith(f"sequence/{what}"):
            for burst, step, state in states(protocol, sequence):
                if burst is not None and burst.looks:
                    assert state.moving or what.startswith("data/"), sequence.id
                    met[step.frame, state.motion] += 1
    return met


def test_every_header_comes_with_all_its_data_in_three_fills(protocol: Protocol) -> None:
    found = swept(protocol, "headers/")

    met: Counter[bytes] = Counter()
    for (frame, _), times in found.items():
        met[frame] += times
    # Stops, a motion that would be seen if it were run, all bits set.
    fills = [bytes([header]) + fill * (header & 15) for header in range(256) for fill in FILLS]
    assert met == Counter(fills)
    assert {motion for _, motion in found} == MOVING


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("data/", {0x11: range(256), 0x41: range(256), 0x51: range(256), 0x81: range(8)}),
        ("bad-data/", {0x81: range(8, 256)}),
    ],
)
def test_every_value_meets_each_kind_of_motion_once(
    protocol: Protocol, what: str, values: dict[int, range]
) -> None:
    frames = [bytes([header, value]) for header, found in values.items() for value in found]

    assert swept(protocol, what) == dict.fromkeys(product(frames, MOVING), 1)


def test_standard_leaves_nothing_out_but_some_of_the_cuts(protocol: Protocol) -> None:
    found = covered(protocol, level_cases(protocol, "standard", 1))

    assert {name for name, (done, of) in found.items() if done < of} == {CUTS, TRIPLES}


def pairs_in_motion(kinds: set[str]) -> set[tuple[str, str, Motion]]:
    """Every ordered pair of kinds, with each kind of motion in which the second can come."""
    found = set()
    for first in kinds:
        motions = set(Motion) if first in SETTINGS else {MOVERS.get(first, Motion.STOPPED)}
        found |= {(first, second, motion) for second in kinds for motion in motions}
    return found


def pairs_met(protocol: Protocol, level: str) -> set[tuple[str, str, Motion]]:
    met = set()
    for sequence in sequences_of(protocol, level):
        if sequence.id.startswith("sequence/tour/"):
            last = ""
            for burst, step, state in states(protocol, sequence):
                kind = kind_of(protocol, step)
                if burst is not None:
                    met.add((last, kind, state.motion))
                last = kind
    return met


@pytest.mark.parametrize(
    ("level", "more"), [("standard", set()), pytest.param("deep", {CUT}, marks=DEEP)]
)
def test_every_pair_of_kinds_is_met_in_every_kind_of_motion(
    protocol: Protocol, level: str, more: set[str]
) -> None:
    met = pairs_met(protocol, level)

    assert pairs_in_motion(WHOLE | more) - met == set()


def test_standard_delivers_every_pair_of_kinds_in_one_go_too(protocol: Protocol) -> None:
    met = {
        tuple(kind_of(protocol, step) for step in steps)
        for sequence in sequences_of(protocol)
        for burst in sequence.bursts
        if burst.delivery == "pipelined"
        for steps in pairwise(burst.steps)
    }

    assert set(product(WHOLE, repeat=2)) - met == set()


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("level", "count"),
    [("smoke", 30), ("standard", 300), pytest.param("deep", 1100, marks=DEEP)],
)
def test_so_many_faults_come_in_a_row_each_while_the_robot_moves(
    protocol: Protocol, level: str, count: int
) -> None:
    (row,) = [w for w in sequences_of(protocol, level) if w.id == "sequence/faults-in-a-row"]
    (alone,) = [w for w in sequences_of(protocol, level) if w.id == "sequence/faults-alone"]

    faults = [(s, state) for _, s, state in states(protocol, row) if s.faulty]
    assert len(faults) == count
    assert all(state.moving for _, state in faults)
    assert {kind_of(protocol, step) for step, _ in faults} == FAULTS
    # Nothing valid between them, and then it is seen whether it still moves.
    kinds = [kind_of(protocol, step) for step in alone.steps]
    assert set(kinds[:count]) == FAULTS
    assert kinds[count:] == list(MOVERS)


@pytest.mark.parametrize("count", [3, 1000])
def test_a_soak_has_as_many_faults_as_it_is_told(protocol: Protocol, count: int) -> None:
    sequences = list(soak(protocol, 1, count))

    assert sum(step.faulty for sequence in sequences for step in sequence.steps) == count
    assert sum(not step.faulty for sequence in sequences for step in sequence.steps) == count
    assert len({sequence.id for sequence in sequences}) == len(sequences)
    told = level_cases(protocol, "smoke", 1, count)
    more = [case for case in told if case.id.startswith("combined/random/")]
    assert len(more) == -(-count // 1000)
    assert told[-len(sequences) - len(more) :] == (*sequences, *more)


# -- what is expected -----------------------------------------------------------------------------


@pytest.mark.sample(1)
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_every_step_agrees_with_the_judge(protocol: Protocol, level: str) -> None:
    for sequence in sequences_of(protocol, level):
        for step in (*sequence.setup, *sequence.steps):
            require_agreement(protocol, step)


def require_agreement(protocol: Protocol, step: Step) -> None:
    judged = judge(protocol, step.frame)
    assert step.accepted[0].codes == (judged.response.code,), step
    assert step.truncated is judged.truncated, step
    assert step.faulty is not judged.valid, step
    assert (step.kind is FrameClass.VALID) is judged.valid, step
    if judged.valid:
        assert judged.instruction is not None
        assert step.frame_effect.effect == judged.instruction.effect
        assert step.frame_effect.values == dict(judged.fields), step
        assert len(step.accepted) == 1, step
    assert len({other.codes for other in step.accepted}) == len(step.accepted), step
    assert step.reading in ("", *READING_IDS)
    for other in step.accepted[1:]:
        assert other.verdict > Verdict.PASS
        assert other.word, step
        assert other.reading in READING_IDS
        assert step.point.split(" ")[0] == step.reading, step


@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_a_walk_begins_in_motion_and_leaves_nothing_open(protocol: Protocol, level: str) -> None:
    for sequence in [found for found in sequences_of(protocol, level) if not found.seeded]:
        names = {judge(protocol, step.frame).name for step in sequence.setup}
        assert not any(step.faulty for step in sequence.setup), sequence.id
        assert {"Speed", "LED"} <= names, sequence.id
        if not sequence.id.startswith(("sequence/faults", "pipelined/soak", "pipelined/dense")):
            assert names & set(MOVERS), sequence.id


@pytest.mark.parametrize("level", [*TOURS[:2], pytest.param(TOURS[2], marks=DEEP)])
def test_a_burst_is_one_that_can_be_sent_and_judged(protocol: Protocol, level: str) -> None:
    for sequence in sequences_of(protocol, level):
        assert sequence.bursts
        for burst in sequence.bursts:
            # What follows a cut frame would be its data.
            assert not any(step.truncated for step in burst.steps[:-1]), sequence.id
            assert list(burst.pauses) == sorted(set(burst.pauses)), sequence.id
            assert all(0 < place < len(burst.data) for place in burst.pauses), sequence.id
            assert len(burst.pauses) <= MOST_PAUSES, sequence.id
            assert not (burst.pauses and burst.steps[-1].truncated), sequence.id
            assert not (burst.idle_ms and not burst.looks), sequence.id


# -- seeds and ids --------------------------------------------------------------------------------


def test_a_group_that_is_independent_is_the_same_without_the_others(protocol: Protocol) -> None:
    whole = level_cases(protocol, "standard", 1)
    left_out = frozenset(INDEPENDENT_GROUPS[1:])
    found = level_cases(protocol, "standard", 1, 0, 0, left_out)
    assert found == tuple(c for c in whole if c.id.rpartition("/")[0] not in left_out)


@pytest.mark.sample(3)
@pytest.mark.parametrize(
    ("glob", "reached"),
    [
        ("bad-data/LED/?", False),
        ("split/tour/001", True),
        ("*/tour/00[12]", True),
        ("[p]ipelined/tour/*", True),
    ],
)
def test_a_glob_chooses_the_same_whether_or_not_the_sequences_are_made(
    protocol: Protocol, glob: str, reached: bool
) -> None:
    every = [case for case in level_cases(protocol, "standard", 1) if fnmatchcase(case.id, glob)]

    chosen = select_cases(protocol, Options(only=(glob,)))

    assert list(chosen) == every != []
    assert reaches([glob], SEQUENCE_PREFIXES) is reached


def test_the_same_seed_makes_the_same_walks(protocol: Protocol) -> None:
    # To what remembers cases it is another grammar.
    again = replace(protocol, source=f"{protocol.source}\n")

    assert [sent(sequence) for sequence in sequences_of(again, "smoke")] == [
        sent(sequence) for sequence in sequences_of(protocol, "smoke")
    ]


def sent(sequence: SequenceCase) -> tuple[object, ...]:
    """What a walk sends, and how."""
    bursts = tuple((b.data, b.pauses, b.looks, b.idle_ms) for b in sequence.bursts)
    return sequence.id, tuple(step.frame for step in sequence.setup), bursts


@pytest.mark.parametrize("level", ["smoke", pytest.param("standard", marks=DEEP)])
def test_another_seed_makes_other_walks_with_the_same_ids(protocol: Protocol, level: str) -> None:
    one, two = (sequences_of(protocol, level, seed) for seed in (1, 2))

    assert [sequence.id for sequence in one] == [sequence.id for sequence in two]
    same = {a.id for a, b in zip(one, two, strict=True) if sent(a)[1:] == sent(b)[1:]}
    again = (f"sequence/again/{s.name}" for s in protocol.instructions if not s.length)
    swept = (
        *("sequence/data/", "sequence/bad-data/", "sequence/headers/", "pipelined/dense"),
        *again,
    )
    assert same == {sequence.id for sequence in one if sequence.id.startswith(swept)}


def test_the_third_of_a_kind_in_a_row_is_tried(protocol: Protocol) -> None:
    def darkened(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        stops = event.judgement.name == "Stop"
        row = device.memory["row"] = device.memory.get("row", 0) + 1 if stops else 0
        dark = dataclasses.replace(reaction, state=reaction.state.but(led=0))
        return dark if row == 3 else reaction

    fault = Fault("x", "test", "", react=darkened)
    report = conform(Simulator(protocol, fault), options=Options(only=("sequence/again/*",)))

    failed = [result.id for result in report.results if result.verdict is Verdict.FAIL]
    assert failed == ["sequence/again/Stop"]


# -- another grammar ------------------------------------------------------------------------------


@pytest.mark.sample(0)
def test_a_horn_is_swept_and_toured(horn: Protocol) -> None:
    for what, values in (("data/Horn", range(4)), ("bad-data/Horn", range(4, 256))):
        frames = [bytes([0x91, value]) for value in values]
        assert swept(horn, what) == dict.fromkeys(product(frames, MOVING), 1)
    for sequence in sequences_of(horn)[::9]:
        for step in (*sequence.setup, *sequence.steps):
            require_agreement(horn, step)
    kinds = WHOLE | {"Horn"}
    met = pairs_met(horn, "standard")
    # The horn changes no motion: it may come in each of them, like a setting.
    wanted = {(a, b, m) for a, b, m in pairs_in_motion(kinds) if a != "Horn"}
    wanted |= {("Horn", kind, motion) for kind in kinds for motion in MOVING}
    assert wanted - met == set()
