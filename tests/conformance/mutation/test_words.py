"""The words of which faults are made: triggers (when), effects and hooks (what), templates."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.effects import EFFECTS, WATCHING
from bilprov.conformance.mutation.faults import Family, Row, filled, globs, hooks, table
from bilprov.conformance.mutation.hooks import HOOKS
from bilprov.conformance.mutation.triggers import (
    COUNTERS,
    FRAME,
    HISTORY,
    OPERATORS,
    STATE,
    trigger,
)
from bilprov.conformance.mutation.variants import VariantRow
from bilprov.spec.protocol import Protocol
from tests.support.faults import made

# A pause of 2 ms between frames, a time-out after each frame that is cut short ("|").
TURN, TIME_OUT = 2 * MS, 100 * MS

# What is sent and, typed by hand, the frames (from 0) at which each trigger holds: Speed 200,
# Forward, LED 4, an unused ID, Stop, LED cut short, LED 9, Right 3, RotateRight, Stop with data.
SENT = "11c8 20 8104 90 00 81| 8109 4103 60 0107"
HOLDS = {
    "": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9],
    "valid": [0, 1, 2, 4, 7, 8],
    "faulty": [3, 5, 6, 9],
    "whole": [0, 1, 2, 3, 4, 6, 7, 8, 9],
    "truncated": [5],
    "outcome unknown-id": [3],
    "outcome bad-data": [6],
    "outcome too-many": [9],
    "outcome truncated": [5],
    "fault too-few": [5],
    "instruction Stop LED": [2, 4],
    "name LED": [2, 5, 6],
    "known 0": [3],
    "has-bits": [2, 5, 6],
    "id 8 9": [2, 3, 5, 6],
    "length 0": [1, 3, 4, 8],
    "length > 0": [0, 2, 5, 6, 7, 9],
    "excess": [9],
    "size 1": [1, 3, 4, 5, 8],
    "first-byte & 4": [2, 9],
    "last-byte < 9": [2, 7, 9],
    "second-byte 0": [],
    "value >= 4": [0, 2, 6],
    "value !& 8": [2, 7],
    "meaningless-bits 8": [6],
    "sets steering": [7],
    "sets-motion": [1, 4, 8],
    "turns": [1, 8],
    "open R-stop-speed": [4],
    "moves forward": [2, 3],
    "moves stopped": [0, 1, 4, 5, 6, 7, 8],
    "motion stopped": [0, 1, 4, 5, 6, 7, 8],
    "rotates": [9],
    "speed >= 200": [1, 2, 3, 4, 5, 6, 7, 8, 9],
    "steering 3": [8, 9],
    "led 4": [3, 4, 5, 6, 7, 8, 9],
    "pipelined": [],
    "pause > 1": [],
    "gap >= 50": [6],
    "frames 1": [1],
    "frames every 4": [3, 7],
    "faults >= 2": [6, 7, 8, 9],
    "truncated-frames": [6, 7, 8, 9],
    "row > 0": [4, 6, 7],
    "previous Forward": [2],
    "previous too-few": [6],
    "after-truncated": [6],
    "times < 3": [0, 1, 2],
    "faulty, times every 2": [5, 9],
    "valid, times & 1": [1, 4, 8],
    "times >= 3, valid": [4, 7, 8],
}
PLAIN = {(when, "", ""): held for when, held in HOLDS.items()}
# The same with `since` and `until`: each is included.
LATCHED = {
    ("", "faulty", ""): [3, 4, 5, 6, 7, 8, 9],
    ("", "faulty", "instruction Stop"): [3, 4, 5, 6, 7, 8, 9],
    ("", "outcome unknown-id", "instruction Stop"): [3, 4],
    ("faulty", "truncated", "faulty, whole"): [5, 6],
    ("valid", "times >= 4", "times >= 5"): [4, 7, 8],
}


def frames(sent: str) -> list[tuple[bytes, int]]:
    """The frames and the time to wait after each."""
    words = sent.split()
    return [(bytes.fromhex(w.rstrip("|")), TIME_OUT if w[-1] == "|" else TURN) for w in words]


def answered(robot: Simulator, sent: str = SENT) -> list[bytes]:
    """What the robot answers to each frame, and until the next."""
    now, found = 0, []
    for frame, wait in frames(sent):
        for byte in frame:
            robot.receive(bytes([byte]), now)
        found.append(robot.advance(now))
        now += wait
        found[-1] += robot.advance(now - 1)
    return found


@pytest.mark.parametrize(
    ("when", "since", "until", "expected"),
    [(*words, held) for words, held in (*PLAIN.items(), *LATCHED.items())],
)
def test_a_trigger_holds_at_these_frames(
    protocol: Protocol, when: str, since: str, until: str, expected: list[int]
) -> None:
    fault = replace(
        made(protocol, "twice"), **hooks(protocol, Row("", "twice", when, since, until))
    )

    found = answered(Simulator(protocol, fault))

    assert [turn for turn, codes in enumerate(found) if len(codes) == 2] == expected


def test_every_subject_and_operator_is_tried() -> None:
    used = {word for when in HOLDS for term in when.split(",") for word in term.split()[:2]}

    assert {*FRAME, *STATE, *HISTORY, *COUNTERS, "times"} <= used
    assert set(OPERATORS) - used == {"", "==", "!="}


def test_deliveries_are_told_apart(protocol: Protocol) -> None:
    ahead = Simulator(protocol, made(protocol, "twice", "pipelined"))
    ahead.receive(b"\0\0", 0)
    split = Simulator(protocol, made(protocol, "twice", "pause > 1"))
    split.receive(b"\x11", 0)
    split.receive(b"\x22", 2 * MS)

    assert ahead.advance(MS) == bytes(3)
    assert split.advance(3 * MS) == bytes(2)


# A fault of each effect on Speed, Forward, LED 4, an unused ID, Speed again: its trigger, the
# answers in order, and what is seen at the end (motion, speed, steering, LED).
EFFECT_FRAMES = "1163 20 8104 90 1162"
CONFORMING = "0 0 0 1 0"
EFFECTS_SEEN = [
    ("answers-with 7 8", "faulty", "0 0 0 78 0", "stopped 98 0 4"),
    ("answers-as too-few", "valid", "4 4 4 1 4", "stopped 98 0 4"),
    ("silent", "faulty", "0 0 0 - 0", "stopped 98 0 4"),
    ("answers-as-before", "row > 0", "0 0 0 1 1", "stopped 98 0 4"),
    ("adds-to-code 2", "faulty", "0 0 0 3 0", "stopped 98 0 4"),
    ("codes-reversed", "faulty", "0 0 0 4 0", "stopped 98 0 4"),
    ("answers-again 1", "faulty", "0 0 0 11 0", "stopped 98 0 4"),
    ("answers-later 1 5 6", "faulty", "0 0 0 156 0", "stopped 98 0 4"),
    ("late 3", "faulty", "0 0 0 - 01", "stopped 98 0 4"),
    ("drives-on", "faulty", CONFORMING, "forward 98 0 4"),
    ("starts-driving", "instruction Speed", CONFORMING, "forward 98 0 4"),
    ("stands-still", "instruction LED", CONFORMING, "stopped 98 0 4"),
    ("does Forward RotateLeft; drives-on", "instruction Forward", CONFORMING, "stopped 98 0 4"),
    ("sets speed 5", "faulty, row 0", CONFORMING, "stopped 98 0 4"),
    ("keeps speed", "instruction Speed, frames > 0", CONFORMING, "stopped 99 0 4"),
    ("adds-up speed 150", "instruction Speed", CONFORMING, "stopped 150 0 4"),
    ("sets-bit speed 0", "instruction Speed", CONFORMING, "stopped 99 0 4"),
    ("clears-bit speed 1", "instruction Speed", CONFORMING, "stopped 96 0 4"),
    ("turns-bits led 7", "faulty", CONFORMING, "stopped 98 0 3"),
    ("divides speed 2", "instruction Speed", CONFORMING, "stopped 49 0 4"),
    ("reverses-bits led 3", "instruction LED", CONFORMING, "stopped 98 0 1"),
    ("resumes-after 1", "faulty", CONFORMING, "forward 98 0 4"),
    ("jerks 1 3", "faulty", CONFORMING, "forward 98 0 4"),
    ("accepts", "faulty", "0 0 0 0 0", "forward 98 0 4"),
    ("loses", "instruction LED", "0 0 - 1 0", "stopped 98 0 0"),
    ("takes-for LED 9", "", "0 0 0 4 0", "stopped 98 0 4"),
    ("knows-no LED", "", "0 0 1 1 0", "stopped 98 0 0"),
    ("restarts", "instruction Speed", CONFORMING, "forward 98 0 4"),
    ("chooses R-led-state:fault off", "", CONFORMING, "stopped 98 0 0"),
    ("loses-next-byte", "instruction LED", "0 0 0 - 0", "forward 98 0 4"),
    ("runs-data unused 9", "", CONFORMING, "stopped 98 0 4"),
]


@pytest.mark.parametrize(("what", "when", "codes", "seen"), EFFECTS_SEEN)
def test_an_effect_does_what_its_word_says(
    protocol: Protocol, what: str, when: str, codes: str, seen: str
) -> None:
    robot = Simulator(protocol, made(protocol, what, when))

    found = answered(robot, EFFECT_FRAMES)

    assert found == [bytes(map(int, word.strip("-"))) for word in codes.split()]
    state = robot.state
    assert f"{state.motion} {state.speed} {state.steering} {state.led}" == seen


# What devices answer to bytes without a pause: the frames in which they take them.
BYTES_SEEN = [
    ("buffer 3", "00000000", "000000"),
    ("torn-between-chunks 2", "001120", "0000"),
    ("takes-what-is-needed", "106320", "0400"),
    ("swaps-length-and-id", "2000", ""),
    ("swaps-length-and-id", "200000", "00"),
    ("runs-data too-long", "0120", "0400"),
    ("refuses-at-header", "0220209120", "0301"),
    ("restarts 1; answers-with 7", "1163209081041163", "0707010707"),
    ("answers-as-first", "90810990", "010101"),
    ("queue 2", "000000", "0000"),
    ("deaf-after-fault", "909090", "01"),
]


@pytest.mark.parametrize(("what", "sent", "codes"), BYTES_SEEN)
def test_a_device_takes_bytes_as_its_word_says(
    protocol: Protocol, what: str, sent: str, codes: str
) -> None:
    when = {"refuses-at-header": "faulty, length > 0", "answers-as-first": "faulty"}
    robot = Simulator(protocol, made(protocol, what, when.get(what, "valid")))

    for byte in bytes.fromhex(sent):
        robot.receive(bytes([byte]), 0)

    assert robot.advance(0).hex() == codes


@pytest.mark.parametrize(
    ("what", "wheels"),
    [
        ("wheels-astray reversed speed 99", (-99, -60)),
        ("wheels-astray half speed 99", (49, 29)),
        ("wheels-astray reversed steering 100", (60, 99)),
        ("wheels-astray half speed 100", (99, 60)),
        ("wheels-level-off 33", (33, 20)),
    ],
)
def test_wheels_turn_as_the_word_says(
    protocol: Protocol, what: str, wheels: tuple[int, int]
) -> None:
    robot = Simulator(protocol, made(protocol, what))
    robot.receive(bytes.fromhex("1163416420"), 0)  # Speed 99, Right 100, Forward

    look = robot.look(0)

    assert (look.left, look.right) == wheels


def test_every_word_of_the_tables_is_known_and_every_known_word_is_used(
    protocol: Protocol,
) -> None:
    families = table("faults.toml", dict[str, Family]).values()
    rows = [row for family in families for row in family.faults.values()]
    rows += table("variants.toml", dict[str, VariantRow]).values()
    used = {part.split()[0] for row in rows for part in row.what.split(";") if part.strip()}
    drawn = {"turns-bits", "wheels-astray", "loses-next-byte", "chooses"}

    assert used | drawn == {*EFFECTS, *WATCHING, *HOOKS}


@pytest.mark.parametrize("text", ["nothing", "valid, sped > 3"])
def test_an_unknown_word_of_a_trigger_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a trigger has no subject"):
        trigger(text)


def test_a_template_is_filled_in_for_each_and_left_out_where_a_name_is_missing(
    protocol: Protocol,
) -> None:
    rows = {
        "{each}-late": Row("{each}", "late 1", "instruction {each}", each="movers"),
        "missing": Row("", "silent", "id {unused[99]}"),
        "unknown": Row("", "silent", "id {no_such}"),
    }

    found = dict(filled(protocol, rows))

    assert list(found) == [
        f"{n}-late" for n in ("Forward", "Backward", "RotateRight", "RotateLeft")
    ]
    assert found["Forward-late"].when == "instruction Forward"


def test_words_of_cases_stand_for_globs() -> None:
    assert globs("truncated valid/*") == (
        *("truncated/*", "recovery/truncated/*", "timing/truncation-timeout"),
        "valid/*",
    )


@pytest.mark.parametrize(("timeout", "pause", "codes"), [("50", 60, "0300"), ("", 10_000, "03")])
def test_a_pause_that_truncates_a_frame_ends_its_data(
    protocol: Protocol, timeout: str, pause: int, codes: str
) -> None:
    what = f"refuses-at-header; time-out {timeout}"
    robot = Simulator(protocol, made(protocol, what, "faulty, length > 0"))

    robot.receive(b"\x02", 0)
    robot.receive(b"\x20", pause * MS)

    assert robot.advance(pause * MS).hex() == codes
