"""Sequences: they cover all combinations, use each kind of delivery, and agree with the judge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase

import pytest
from msgspec.structs import replace

from bilprov.conformance.api import Options, select_cases
from bilprov.conformance.cases.budget import group
from bilprov.conformance.cases.levels import (
    GENERATORS,
    INDEPENDENT_GROUPS,
    LEVELS,
    SEQUENCE_PREFIXES,
    level_cases,
    reaches,
    single_cases,
)
from bilprov.conformance.cases.proof import GROUP, PROOFS
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.cases.sweeps import soak
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.codec import judge
from bilprov.spec.motion import Motion, visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from tests.vectors import BAD_DATA_FRAMES, READING_IDS

SEEDS = (1, 2)
MOVERS = {
    "Forward": Motion.FORWARD,
    "Backward": Motion.BACKWARD,
    "RotateRight": Motion.ROTATE_RIGHT,
    "RotateLeft": Motion.ROTATE_LEFT,
}
MOVING = set(MOVERS.values())
SETTINGS = {"Speed": range(256), "Right": range(256), "Left": range(256), "LED": range(8)}
FAULTS = {"BAD_HEADER", "BAD_DATA", "TOO_MANY_DATA", "TOO_FEW_DATA"}
WHOLE = {"Stop", *MOVERS, *SETTINGS, *FAULTS}
CUT = "cut short"
# Where a walk may be split: one time-out over the whole frame must not be reached by its pauses.
MOST_PAUSES = 4
# The levels that hold nothing but tours and sweeps; `test_proof` is about the other.
TOURS = ("smoke", "standard", "deep")
# Its cases take seconds to make.
DEEP = [pytest.mark.slow, pytest.mark.sample(0)]
EACH_TOUR = [*TOURS[:2], pytest.param(TOURS[2], marks=DEEP)]


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


@pytest.mark.slow
def test_every_header_comes_with_all_its_data_in_three_fills(protocol: Protocol) -> None:
    met: dict[int, Counter[bytes]] = {}
    for sequence in sequences_of(protocol):
        if sequence.id.startswith("sequence/headers"):
            name = int(sequence.id.split("/")[2].split("-")[0], 16)
            for burst in sequence.bursts:
                (step,) = burst.steps
                if burst.looks:
                    met.setdefault(step.frame[0], Counter())[step.frame[1:]] += 1
                    assert name <= step.frame[0] < name + 32, sequence.id

    assert set(met) == set(range(256))
    for header, fills in met.items():
        length = header & 0x0F
        # Stops, a motion that would be seen if it were run, all bits set.
        assert fills == Counter([b"\x00" * length, b"\x20" * length, b"\xff" * length])


@pytest.mark.slow
@pytest.mark.parametrize("what", ["headers", "data", "bad-data"])
def test_what_is_swept_is_sent_while_the_robot_moves(protocol: Protocol, what: str) -> None:
    met = set()
    for sequence in sequences_of(protocol):
        if not sequence.id.startswith(f"sequence/{what}/"):
            continue
        for burst, _, state in states(protocol, sequence):
            if burst is not None and burst.looks:
                assert state.motion in MOVING, sequence.id
                assert state.moving or what == "data", (
                    sequence.id
                )  # where Speed 0 is among the data
                met.add(state.motion)

    assert met == MOVING


@pytest.mark.slow
def test_every_value_of_every_setting_meets_each_kind_of_motion(protocol: Protocol) -> None:
    met: Counter[tuple[str, int, Motion]] = Counter()
    for sequence in sequences_of(protocol):
        if sequence.id.startswith("sequence/data/"):
            for burst, step, state in states(protocol, sequence):
                if burst is not None:
                    judged = judge(protocol, step.frame)
                    ((_, value),) = judged.fields
                    met[judged.name, value, state.motion] += 1

    wanted = {(n, v, m) for n, values in SETTINGS.items() for v in values for m in MOVING}
    assert met == dict.fromkeys(wanted, 1)


@pytest.mark.slow
def test_every_value_out_of_range_meets_each_kind_of_motion(protocol: Protocol) -> None:
    met: Counter[tuple[bytes, Motion]] = Counter()
    for sequence in sequences_of(protocol):
        if sequence.id.startswith("sequence/bad-data/"):
            for burst, step, state in states(protocol, sequence):
                if burst is not None and burst.looks:
                    met[step.frame, state.motion] += 1

    wanted = {(bytes([0x81, value]), m) for value in range(8, 256) for m in MOVING}
    assert met == dict.fromkeys(wanted, 1)
    assert {vector.frame for vector in BAD_DATA_FRAMES} <= {frame for frame, _ in met}


def pairs_in_motion(kinds: set[str]) -> set[tuple[str, str, Motion]]:
    """Every ordered pair of kinds, with each kind of motion in which the second can come."""
    found = set()
    for first in kinds:
        motions = set(Motion) if first in SETTINGS else {MOVERS.get(first, Motion.STOPPED)}
        found |= {(first, second, motion) for second in kinds for motion in motions}
    return found


def pairs_met(
    protocol: Protocol, level: str, prefix: str, seed: int = 1
) -> set[tuple[str, str, Motion]]:
    met = set()
    for sequence in sequences_of(protocol, level, seed):
        if sequence.id.startswith(prefix):
            last = ""
            for burst, step, state in states(protocol, sequence):
                kind = kind_of(protocol, step)
                if burst is not None:
                    met.add((last, kind, state.motion))
                last = kind
    return met


@pytest.mark.slow
@pytest.mark.parametrize("seed", [SEEDS[0], pytest.param(SEEDS[1], marks=DEEP)])
def test_standard_meets_every_pair_of_kinds_in_every_kind_of_motion(
    protocol: Protocol, seed: int
) -> None:
    met = pairs_met(protocol, "standard", "sequence/tour/", seed)

    assert pairs_in_motion(WHOLE) - met == set()


@pytest.mark.sample(0)
@pytest.mark.slow
def test_deep_meets_every_pair_with_frames_cut_short_too(protocol: Protocol) -> None:
    met = pairs_met(protocol, "deep", "sequence/tour/")

    assert pairs_in_motion(WHOLE | {CUT}) - met == set()


@pytest.mark.slow
@pytest.mark.parametrize("way", ["pipelined", "split"])
def test_standard_delivers_every_pair_of_kinds_in_one_go_too(protocol: Protocol, way: str) -> None:
    met = {
        tuple(kind_of(protocol, step) for step in steps)
        for sequence in sequences_of(protocol)
        for burst in sequence.bursts
        if burst.delivery == ("pipelined" if way == "pipelined" else "split")
        for steps in zip(burst.steps, burst.steps[1:], strict=False)
    }
    wanted = {(first, second) for first in WHOLE for second in WHOLE}

    if way == "pipelined":
        assert wanted - met == set()
    else:
        # Where a pause falls matters to a frame; which frame is beside it much less.
        assert {kind for pair in met for kind in pair} == WHOLE
        assert len(met & wanted) > len(wanted) // 2


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR)
def test_each_level_delivers_in_each_way(protocol: Protocol, level: str) -> None:
    met = Counter(
        burst.delivery for sequence in sequences_of(protocol, level) for burst in sequence.bursts
    )
    ways = {"waited", "pipelined", "split", "left alone", "cut"}

    assert set(met) == ways
    assert min(met.values()) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR[1:])
def test_every_kind_is_left_alone_in_each_kind_of_motion(protocol: Protocol, level: str) -> None:
    met = {
        (kind_of(protocol, step), visible_motion(state))
        for sequence in sequences_of(protocol, level)
        if sequence.id.startswith("sequence/left-alone/")
        for burst, step, state in states(protocol, sequence)
        if burst is not None and burst.idle_ms
    }

    assert {kind for kind, _ in met} >= WHOLE | {CUT}
    if level == "deep":
        wanted = {(kind, motion) for kind in WHOLE | {CUT} for motion in Motion}
        assert wanted - met == set()


@pytest.mark.slow
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


@pytest.mark.parametrize("count", [3, 100, 1000])
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", "standard"])
def test_a_walk_begins_in_motion_and_leaves_nothing_open(protocol: Protocol, level: str) -> None:
    for sequence in [found for found in sequences_of(protocol, level) if not found.seeded]:
        names = {judge(protocol, step.frame).name for step in sequence.setup}
        assert not any(step.faulty for step in sequence.setup), sequence.id
        assert {"Speed", "LED"} <= names, sequence.id
        if not sequence.id.startswith(("sequence/faults", "pipelined/soak", "pipelined/dense")):
            assert names & set(MOVERS), sequence.id


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR)
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


@pytest.mark.slow
def test_pauses_fall_inside_frames_and_between_them(protocol: Protocol) -> None:
    inside = between = 0
    for sequence in sequences_of(protocol):
        for burst in sequence.bursts:
            ends, end = set(), 0
            for step in burst.steps:
                end += len(step.frame)
                ends.add(end)
            for place in burst.pauses:
                between += place in ends
                inside += place not in ends

    assert inside > 50
    assert between > 20


# -- seeds and ids --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR)
def test_a_level_holds_the_groups_of_the_generators_that_it_has_an_amount_of(
    protocol: Protocol, level: str
) -> None:
    found = {group(sequence.id) for sequence in sequences_of(protocol, level)}

    assert found == {row.group for row in GENERATORS if row.amount(LEVELS[level])}


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR)
def test_ids_are_unique_at_each_level(protocol: Protocol, level: str) -> None:
    soaked = 500 if level == "smoke" else 0
    counted = Counter(case.id for case in level_cases(protocol, level, 1, soaked))

    assert [ident for ident, times in counted.items() if times > 1] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("less", "more"), [TOURS[:2], pytest.param(*TOURS[1:], marks=DEEP)], ids=str
)
def test_each_level_holds_the_ids_of_the_one_before(
    protocol: Protocol, less: str, more: str
) -> None:
    fewer, many = ({case.id for case in level_cases(protocol, name, 1)} for name in (less, more))

    assert fewer < many


def test_the_level_complete_holds_what_standard_does_and_the_proofs() -> None:
    more = {
        row.group
        for row in GENERATORS
        if row.amount(LEVELS["complete"]) != row.amount(LEVELS["standard"])
    }

    assert more == {f"{GROUP}/{one.name}" for one in PROOFS}


@pytest.mark.slow
def test_a_group_that_is_independent_is_the_same_without_the_others(protocol: Protocol) -> None:
    whole = level_cases(protocol, "standard", 1)
    for left_out in (INDEPENDENT_GROUPS[1:],):
        found = level_cases(protocol, "standard", 1, 0, 0, frozenset(left_out))
        assert found == tuple(c for c in whole if c.id.rpartition("/")[0] not in left_out)


@pytest.mark.slow
@pytest.mark.parametrize("level", EACH_TOUR)
def test_the_cases_that_are_no_sequences_come_first_and_are_made_alone(
    protocol: Protocol, level: str
) -> None:
    cases, singles = level_cases(protocol, level, 1), single_cases(protocol, level, 1)

    assert cases[: len(singles)] == singles
    assert all(isinstance(case, SequenceCase) for case in cases[len(singles) :])
    ids = [case.id for case in cases if case.id.startswith(SEQUENCE_PREFIXES)]
    assert ids == [case.id for case in cases[len(singles) :]]


@pytest.mark.sample(3)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("glob", "reached"),
    [
        ("valid/LED/1", False),
        ("valid/*", False),
        ("bad-data/LED/?", False),
        ("split/tour/001", True),
        ("split/*", True),
        ("*/tour/00[12]", True),
        ("[p]ipelined/tour/*", True),
        ("s*", True),
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


@pytest.mark.slow
@pytest.mark.parametrize("level", ["smoke", pytest.param("standard", marks=DEEP)])
def test_another_seed_makes_other_walks_with_the_same_ids(protocol: Protocol, level: str) -> None:
    one, two = (sequences_of(protocol, level, seed) for seed in SEEDS)

    assert [sequence.id for sequence in one] == [sequence.id for sequence in two]
    same = {a.id for a, b in zip(one, two, strict=True) if sent(a)[1:] == sent(b)[1:]}
    swept = ("sequence/data/", "sequence/bad-data/", "sequence/headers/", "pipelined/dense")
    assert same == {sequence.id for sequence in one if sequence.id.startswith(swept)}


# -- another grammar ------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_horn_is_swept_and_toured(horn: Protocol) -> None:
    sequences = sequences_of(horn)
    values, refused = set(), set()
    for sequence in sequences:
        for burst, step, state in states(horn, sequence):
            if burst is not None and sequence.id.startswith("sequence/data/Horn"):
                values.add((step.frame, state.motion))
            if (
                burst is not None
                and burst.looks
                and sequence.id.startswith("sequence/bad-data/Horn")
            ):
                refused.add((step.frame, state.motion))

    assert values == {(bytes([0x91, v]), m) for v in range(4) for m in MOVING}
    assert refused == {(bytes([0x91, v]), m) for v in range(4, 256) for m in MOVING}
    for sequence in sequences[::9]:
        for step in (*sequence.setup, *sequence.steps):
            require_agreement(horn, step)
    kinds = WHOLE | {"Horn"}
    met = pairs_met(horn, "standard", "sequence/tour/")
    # The horn changes no motion: it may come in each of them, like a setting.
    wanted = {(a, b, m) for a, b, m in pairs_in_motion(kinds) if a != "Horn"}
    wanted |= {("Horn", kind, motion) for kind in kinds for motion in MOVING}
    assert wanted - met == set()
