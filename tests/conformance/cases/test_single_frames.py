"""Single-frame cases: their number, what each sends and expects, motions and seeds."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from collections.abc import Iterator

import pytest

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.levels import covered, level_cases, single_cases
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.codec import judge
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import undeclared
from tests.support.robots import FEW_LOOKS, CountingLink, run_over
from tests.vectors import HEADERS, UNUSED_IDS

SEEDS = (1, 2, 77)
MOVING = {Motion.FORWARD, Motion.BACKWARD, Motion.ROTATE_RIGHT, Motion.ROTATE_LEFT}
FAULTY = {FrameClass.UNUSED_ID, FrameClass.WRONG_LENGTH, FrameClass.BAD_DATA, FrameClass.TRUNCATED}


@pytest.fixture(scope="module")
def cases(protocol: Protocol) -> tuple[Case, ...]:
    return all_cases(protocol, 1, every_cut=True)


@pytest.fixture(scope="module")
def chosen(protocol: Protocol) -> tuple[Case, ...]:
    """What real time takes."""
    return all_cases(protocol, 1, every_cut=False)


def written_by_hand() -> Iterator[tuple[str, bytes, int]]:
    """(id, stimulus, code) of every single-frame case, from table 1 alone."""
    lengths = {row.id: row.length for row in HEADERS}
    names = {row.id: row.name for row in HEADERS} | {i: str(i) for i in UNUSED_IDS}
    for row in HEADERS:
        if not row.length:
            yield f"valid/{row.name}", bytes([row.id << 4]), 0
        for value in range(256 if row.length else 0):
            frame = bytes([row.id << 4 | 1, value])
            if row.name == "LED" and value > 7:
                yield f"bad-data/LED/{value}", frame, 2
            else:
                yield f"valid/{row.name}/{value}", frame, 0
    for identity in range(16):
        for length in range(16):
            header, used = identity << 4 | length, identity in lengths
            whole = bytes([header]) + bytes(length)
            if not used:
                yield f"unused-id/{identity}/{length}", whole, 1
            elif length != lengths[identity]:
                code = 3 if length > lengths[identity] else 4
                yield f"wrong-length/{names[identity]}/{length}", whole, code
            for arrived in range(length):
                short = f"truncated/{names[identity]}"
                if not used or length != lengths[identity]:
                    short += f"/{length}"
                yield f"{short}/{arrived}", whole[: 1 + arrived], 4 if used else 1


def test_the_single_frames_are_those_of_the_table_and_no_others(cases: tuple[Case, ...]) -> None:
    made = {
        case.id: (case.frame, *case.accepted[0].codes)
        for case in cases
        if case.kind is not FrameClass.RECOVERY
    }

    assert len(made) + 20 == len({case.id for case in cases}) == len(cases)
    assert made == {ident: (frame, code) for ident, frame, code in written_by_hand()}


@pytest.mark.parametrize(
    ("ident", "stimulus", "code"),
    [
        ("recovery/truncated/Forward", "11", 4),
        ("recovery/too-many/RotateLeft", "01 00", 3),
        ("recovery/too-few/Backward", "10", 4),
        ("recovery/bad-data/Forward", "81 08", 2),
        ("recovery/unused-id/RotateRight", "90", 1),
    ],
)
def test_the_id_of_a_recovery_says_what_is_sent(
    cases: tuple[Case, ...], ident: str, stimulus: str, code: int
) -> None:
    (case,) = [case for case in cases if case.id == ident]

    assert case.frame == bytes.fromhex(stimulus)
    assert case.accepted[0].codes == (code,)
    assert case.accepted[0].verdict is Verdict.PASS


@pytest.mark.parametrize("seed", SEEDS)
def test_each_class_of_fault_meets_each_kind_of_motion(protocol: Protocol, seed: int) -> None:
    met: dict[FrameClass, set[Motion]] = {}
    for case in all_cases(protocol, seed, every_cut=False):
        assert case.setup.moving, case.id
        met.setdefault(case.kind, set()).add(case.setup.motion)

    assert met == dict.fromkeys(FrameClass, MOVING)


@pytest.mark.parametrize("seed", SEEDS)
def test_too_few_data_meet_each_kind_of_motion_although_they_are_rare(
    protocol: Protocol, seed: int
) -> None:
    few = [case for case in all_cases(protocol, seed, every_cut=False) if case.short]

    assert len(few) == 4
    assert {case.setup.motion for case in few} == MOVING


def test_recovery_tries_each_fault_in_each_motion_and_restores_that_motion(
    protocol: Protocol, cases: tuple[Case, ...]
) -> None:
    recovery = [case for case in cases if case.kind is FrameClass.RECOVERY]
    tried = Counter((case.id.split("/")[1], case.setup.motion) for case in recovery)

    assert set(tried.values()) == {1}
    assert len(tried) == 5 * 4
    for case in recovery:
        restored = judge(protocol, case.then).instruction
        assert restored is not None
        assert protocol.car.motion(restored.effect) == case.setup.motion


@pytest.mark.sample(2)
@pytest.mark.parametrize("every_cut", [True, False])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_thorough_cases_are_one_of_each_class_in_each_motion(
    protocol: Protocol, seed: int, every_cut: bool
) -> None:
    thorough = [c for c in all_cases(protocol, seed, every_cut=every_cut) if c.thorough]

    met = Counter((case.accepted[0].codes, case.kind, case.setup.motion) for case in thorough)
    assert len(met) == len(thorough) == 20
    assert len({(codes, kind) for codes, kind, _ in met}) == 5
    assert {kind for _, kind, _ in met} == FAULTY


@pytest.mark.parametrize("seed", SEEDS)
def test_a_person_is_asked_at_most_40_times(protocol: Protocol, seed: int) -> None:
    cases = all_cases(protocol, seed, every_cut=False)
    link = CountingLink(Simulator(protocol))

    runner = run_over(link, protocol, [c for c in cases if c.thorough], observability=FEW_LOOKS)

    assert 20 <= len(link.looks) <= 40
    assert all(
        result.axes["stop"].verdict is Verdict.PASS
        for result in runner.run.results
        if result.id.split("/")[0] in FAULTY
    )


def test_cases_that_are_not_thorough_cost_no_dear_look(protocol: Protocol) -> None:
    cases = [c for c in all_cases(protocol, 1, every_cut=False) if not c.thorough][::20]
    link = CountingLink(Simulator(protocol))

    run_over(link, protocol, cases, observability=FEW_LOOKS)

    assert link.looks == []


def test_another_seed_rotates_other_data_and_motions_through_the_same_cases(
    protocol: Protocol, cases: tuple[Case, ...]
) -> None:
    other = all_cases(protocol, 2, every_cut=True)

    assert [case.id for case in other] == [case.id for case in cases]
    assert [case.frame for case in other] == [case.frame for case in cases]
    moved = sum(a.setup != b.setup for a, b in zip(cases, other, strict=True))
    assert moved > len(cases) * 0.9
    assert [c.setup.motion for c in other] != [c.setup.motion for c in cases]


def test_the_setups_rotate_through_every_value(cases: tuple[Case, ...]) -> None:
    assert {case.setup.speed for case in cases} >= set(range(128, 256))
    assert {case.setup.steering for case in cases} == set(range(-255, 256))
    assert {case.setup.led for case in cases} == set(range(8))


def test_a_valid_instruction_changes_something_that_can_be_seen(cases: tuple[Case, ...]) -> None:
    valid = [case for case in cases if case.kind is FrameClass.VALID]

    assert [case.id for case in valid if case.expected == case.setup] == []


def test_the_cut_that_real_time_takes_rotates(chosen: tuple[Case, ...]) -> None:
    arrived = {len(case.frame) - 1 for case in chosen if case.kind is FrameClass.TRUNCATED}

    assert arrived == set(range(15))


def test_a_grammar_without_limited_fields_has_no_bad_data(grammar_text: str) -> None:
    free = load(undeclared(grammar_text).replace("Ranged(Byte, 0, 7,", "Ranged(Byte, 0, 255,"))

    kinds = Counter(case.kind for case in all_cases(free, 1, every_cut=False))
    assert kinds[FrameClass.BAD_DATA] == 0
    assert kinds[FrameClass.RECOVERY] == 16


@pytest.mark.slow
def test_a_grammar_whose_robot_cannot_move_has_cases_too(grammar_text: str) -> None:
    before, rest = grammar_text.split('    1: "Speed"')
    stop_only = load(before + rest[rest.index("}\n\nFRAME =") :], "stop.py")

    for level in ("smoke", "standard"):
        cases = level_cases(stop_only, level, 1)
        assert {case.id.split("/")[0] for case in cases} >= {"valid", "unused-id", "wrong-length"}


@pytest.mark.sample(0)
@pytest.mark.slow
def test_a_field_of_four_bytes_takes_no_more_memory_than_one_of_one(grammar_text: str) -> None:
    speed = '"speed" / Ranged(Byte, 0, 255)'
    assert grammar_text.count(speed) == 1
    text = undeclared(grammar_text).replace(speed, '"speed" / Ranged(Int32ub, 0, 4_000_000_000)')
    wide = load(text.replace("BitStruct, Byte,", "BitStruct, Byte, Int32ub,"), "wide.py")

    tracemalloc.start()
    singles = single_cases(wide, "standard", 1)
    counted = covered(wide, level_cases(wide, "smoke", 1, soaked=1000))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert len(singles) > 1000
    assert counted["combinations of three"][0] > 0
    assert most < 100_000_000
