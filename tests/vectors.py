"""The independent witness: frames, answers and states typed by hand from the document.

Nothing here is computed from the grammar and nothing of the kit is imported. Each entry names its
clause of the document (MindRoad, 2015-06-23, v1.1) or the reading or erratum that it rests on.
"""

from __future__ import annotations

from typing import NamedTuple


class InstructionRow(NamedTuple):
    """A row of table 1: ID, our name, the document's name, number of data bytes, field name."""

    id: int
    name: str
    document: str
    length: int
    field: str = ""


class ResponseRow(NamedTuple):
    """A row of table 2: code, our name, the document's words."""

    code: int
    name: str
    document: str


class FrameVector(NamedTuple):
    """One frame, whole or cut short, and what a conforming device makes of it.

    `name` is None for an unused ID; `fields` are empty unless the lengths are right.
    """

    frame: bytes
    code: int
    name: str | None
    fields: tuple[tuple[str, int], ...]
    clause: str


class RobotState(NamedTuple):
    """What the robot is set to, and whether its wheels turn.

    `steering` is positive to the right. With speed 0 `motion` is remembered and `moving` is false:
    the wheels are then seen stopped.
    """

    motion: str
    speed: int
    steering: int
    led: int
    moving: bool


class Step(NamedTuple):
    """A frame (after a cut-short one the line pauses), its response code, the state after it."""

    frame: bytes
    code: int
    state: RobotState


class Sequence(NamedTuple):
    """Steps from power-on."""

    title: str
    clause: str
    steps: tuple[Step, ...]


class StreamVector(NamedTuple):
    """Bytes sent without a pause, and the frames they are; `rest` waits for more data."""

    title: str
    clause: str
    data: bytes
    frames: tuple[bytes, ...]
    rest: bytes


class WheelVector(NamedTuple):
    """How the wheels turn: sign of left and right, and which is faster ("" if neither)."""

    motion: str
    steering: int
    left: int
    right: int
    faster: str


def _frame(hexed: str, code: int, name: str | None, clause: str, **fields: int) -> FrameVector:
    return FrameVector(bytes.fromhex(hexed), code, name, tuple(fields.items()), clause)


def _step(hexed: str, code: int, *state: object) -> Step:
    return Step(bytes.fromhex(hexed), code, RobotState(*state))  # type: ignore[arg-type]


def _sequences(table: str) -> tuple[Sequence, ...]:
    """Paragraphs of a title, its clause and one line a step."""
    made = []
    for paragraph in table.strip().split("\n\n"):
        heading, *lines = paragraph.splitlines()
        title, clause = heading.split(" | ")
        steps = []
        for line in lines:
            *frame, code, motion, speed, steering, led, moves = line.split()
            state = RobotState(motion, int(speed), int(steering), int(led), moves == "moves")
            steps.append(Step(bytes.fromhex("".join(frame)), int(code), state))
        made.append(Sequence(title, clause, tuple(steps)))
    return tuple(made)


def _stream(title: str, clause: str, written: str) -> StreamVector:
    """Frames, each ended by |, and what is left."""
    base = 2 if "example" in clause else 16
    parts = [bytes(int(byte, base) for byte in part.split()) for part in written.split("|")]
    return StreamVector(title, clause, b"".join(parts), tuple(parts[:-1]), parts[-1])


# Section 3, table 1.
HEADERS = (
    InstructionRow(0, "Stop", "Stopp", 0),
    InstructionRow(1, "Speed", "Hastighet", 1, "speed"),
    InstructionRow(2, "Forward", "Framåt", 0),
    InstructionRow(3, "Backward", "Bakåt", 0),
    InstructionRow(4, "Right", "Höger", 1, "strength"),
    InstructionRow(5, "Left", "Vänster", 1, "strength"),
    InstructionRow(6, "RotateRight", "Rotera hö.", 0),
    InstructionRow(7, "RotateLeft", "Rotera vä.", 0),
    InstructionRow(8, "LED", "LED", 1, "rgb"),
)
UNUSED_IDS = (9, 10, 11, 12, 13, 14, 15)
LONGEST_FRAME = 16  # section 2: 1 to 16 bytes

# Section 4, table 2.
RESPONSES = (
    ResponseRow(0, "OK", "Korrekt instruktion mottagen"),
    ResponseRow(1, "BAD_HEADER", "Felaktig header mottagen"),
    ResponseRow(2, "BAD_DATA", "Felaktig data mottagen"),
    ResponseRow(3, "TOO_MANY_DATA", "För många byte data mottagna"),
    ResponseRow(4, "TOO_FEW_DATA", "För få byte data mottagna"),
)

# R-power-on.
POWER_ON = RobotState("stopped", 0, 0, 0, False)

# Milliseconds: R-truncation-timeout, R-answer-deadline, R-stop-latency.
TIMING = {
    "truncation_timeout": 50,
    "truncation_shortest": 5,
    "truncation_longest": 1000,
    "answer_deadline": 100,
    "answer_longest": 1000,
    "stop_longest": 100,
}

# R-line: 115,200 8N1.
LINE = {"baud": 115200, "parity": "N", "stopbits": 1}

# Table 1, LED: "De sista tre bitarna i databyten styr färgerna i ordningen RGB."
COLOURS = {
    0b000: (),
    0b001: ("B",),
    0b010: ("G",),  # example 5.3: "Sätt RGB-dioden till grönt."
    0b011: ("G", "B"),
    0b100: ("R",),
    0b101: ("R", "B"),
    0b110: ("R", "G"),
    0b111: ("R", "G", "B"),
}

_TABLE_1 = "section 3, table 1"
_TABLE_2 = "section 4, table 2"

VALID_FRAMES = (
    _frame("00", 0, "Stop", _TABLE_1),
    _frame("11 00", 0, "Speed", _TABLE_1, speed=0),
    _frame("11 7f", 0, "Speed", "example 5.2", speed=127),
    _frame("11 ff", 0, "Speed", "example 5.1", speed=255),
    _frame("20", 0, "Forward", "example 5.1"),
    _frame("30", 0, "Backward", "example 5.3"),
    _frame("41 00", 0, "Right", _TABLE_1, strength=0),
    _frame("41 ff", 0, "Right", "example 5.2, corrected (E3)", strength=255),
    _frame("51 00", 0, "Left", _TABLE_1, strength=0),
    _frame("51 ff", 0, "Left", _TABLE_1, strength=255),
    _frame("60", 0, "RotateRight", _TABLE_1),
    _frame("70", 0, "RotateLeft", "example 5.3"),
    _frame("81 00", 0, "LED", _TABLE_1, rgb=0),
    _frame("81 02", 0, "LED", "example 5.3, corrected (E5)", rgb=2),
    _frame("81 05", 0, "LED", _TABLE_1, rgb=5),
    _frame("81 07", 0, "LED", _TABLE_1, rgb=7),
)

# R-led-upper-bits: any of the upper five bits set.
BAD_DATA_FRAMES = (
    _frame("81 08", 2, "LED", "R-led-upper-bits", rgb=8),
    _frame("81 09", 2, "LED", "R-led-upper-bits", rgb=9),
    _frame("81 10", 2, "LED", "R-led-upper-bits", rgb=16),
    _frame("81 80", 2, "LED", "R-led-upper-bits", rgb=128),
    _frame("81 ff", 2, "LED", "R-led-upper-bits", rgb=255),
)

UNUSED_ID_FRAMES = (
    _frame("90", 1, None, _TABLE_1),
    _frame("f0", 1, None, _TABLE_1),
    _frame("91 02", 1, None, "example 5.3, as printed (E5)"),
    _frame("92 00 00", 1, None, "R-unused-length"),
    _frame("b3 20 11 ff", 1, None, "R-unused-length"),
    _frame("9f 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00", 1, None, "R-unused-length"),
    _frame("ff ff ff ff ff ff ff ff ff ff ff ff ff ff ff ff", 1, None, "R-unused-length"),
)

WRONG_LENGTH_FRAMES = (
    _frame("01 00", 3, "Stop", _TABLE_2),
    _frame("0f 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00", 3, "Stop", _TABLE_2),
    _frame("10", 4, "Speed", _TABLE_2),
    _frame("12 ff ff", 3, "Speed", _TABLE_2),
    _frame("1f ff ff ff ff ff ff ff ff ff ff ff ff ff ff ff", 3, "Speed", _TABLE_2),
    _frame("21 ff", 3, "Forward", _TABLE_2),
    _frame("31 01", 3, "Backward", _TABLE_2),
    _frame("40", 4, "Right", "example 5.2, as printed (E3)"),
    _frame("42 ff 00", 3, "Right", "section 3, the illustration 01000010 (E2)"),
    _frame("50", 4, "Left", _TABLE_2),
    _frame("52 00 ff", 3, "Left", _TABLE_2),
    _frame("61 00", 3, "RotateRight", _TABLE_2),
    _frame("71 ff", 3, "RotateLeft", _TABLE_2),
    _frame("80", 4, "LED", _TABLE_2),
    _frame("82 01 00", 3, "LED", _TABLE_2),
    _frame("82 08 00", 3, "LED", "R-competing-errors"),
    _frame("8f 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00", 3, "LED", _TABLE_2),
)

# The line pauses before all that was announced has come.
TRUNCATED_FRAMES = (
    _frame("11", 4, "Speed", "R-truncated-known"),
    _frame("41", 4, "Right", "R-truncated-known"),
    _frame("81", 4, "LED", "R-truncated-known"),
    _frame("01", 4, "Stop", "R-truncated-long"),
    _frame("12 ff", 4, "Speed", "R-truncated-long"),
    _frame("3f ff ff ff ff ff ff ff ff ff ff ff ff ff ff", 4, "Backward", "R-truncated-long"),
    _frame("42", 4, "Right", "R-truncated-long"),
    _frame("82 08", 4, "LED", "R-truncated-long"),
    _frame("91", 1, None, "R-truncated-unused"),
    _frame("9f 00 00 00 00 00 00 00 00 00 00 00 00 00 00", 1, None, "R-truncated-unused"),
    _frame("ff", 1, None, "example 5.2, as printed (E3): the byte is the next header"),
    _frame("ff 11 7f", 1, None, "example 5.2, as printed (E3): it takes the next line as data"),
)

FRAMES = (
    *VALID_FRAMES,
    *BAD_DATA_FRAMES,
    *UNUSED_ID_FRAMES,
    *WRONG_LENGTH_FRAMES,
    *TRUNCATED_FRAMES,
)

# How many single frames there are of each class, over all IDs, lengths and data that matter:
# 5 + 3 x 256 + 8 valid, 7 x 16 unused, 9 x 15 wrong lengths, 256 - 8 bad LED bytes, 16 x 120 cuts.
FRAME_COUNTS = {
    "valid": 781,
    "unused": 112,
    "wrong length": 135,
    "bad data": 248,
    "truncated": 1920,
}

# Binary as in the examples of section 5, hex elsewhere; | ends a frame, what follows it waits.
STREAMS = (
    _stream("full speed forward", "example 5.1", "00100000 | 00010001 11111111 |"),
    _stream(
        "the byte after Right without data is a header and takes the next line as its data",
        "example 5.2, as printed (E3, E4)",
        "00100000 | 01000000 | 11111111 00010001 01111111",
    ),
    _stream(
        "backward right at half speed",
        "example 5.2, corrected (E3, E4)",
        "00110000 | 01000001 11111111 | 00010001 01111111 |",
    ),
    _stream(
        "back, stop, rotate, on, and a LED line with an unused ID",
        "example 5.3, as printed (E5)",
        "00110000 | 00010001 01111111 | 00000000 | 01110000 | 00000000 |"
        "00100000 | 00010001 11111111 | 10010001 00000010 |",
    ),
    _stream("data that look like instructions are data", "section 2", "b3 20 11 ff | 20 |"),
    _stream(
        "a modem probe of ModemManager is Right 84 and a Stop that waits for 13 bytes",
        "section 2",
        "41 54 | 0d",
    ),
)

# Each step: the frame, its response code, then motion, speed, steering, LED, and whether it moves.
DOCUMENT_SEQUENCES = _sequences("""
full speed forward | example 5.1
    20       0  forward        0    0  0  rests
    11 ff    0  forward      255    0  0  moves

backward right at half speed | example 5.2, corrected (E3, E4)
    30       0  backward       0    0  0  rests
    41 ff    0  backward       0  255  0  rests
    11 7f    0  backward     127  255  0  moves

forward right at half speed | example 5.2, corrected (E3 only)
    20       0  forward        0    0  0  rests
    41 ff    0  forward        0  255  0  rests
    11 7f    0  forward      127  255  0  moves

Right without data stops, and its byte takes the speed line with it | example 5.2, as printed (E3)
    20       0  forward        0    0  0  rests
    40       4  stopped        0    0  0  rests
    ff 11 7f 1  stopped        0    0  0  rests

back, stop, rotate left, forward at full speed, green | example 5.3, corrected (E5)
    30       0  backward       0    0  0  rests
    11 7f    0  backward     127    0  0  moves
    00       0  stopped      127    0  0  rests
    70       0  rotate_left  127    0  0  moves
    00       0  stopped      127    0  0  rests
    20       0  forward      127    0  0  moves
    11 ff    0  forward      255    0  0  moves
    81 02    0  forward      255    0  2  moves

the LED line with ID 9 stops the robot | example 5.3, as printed (E5)
    30       0  backward       0    0  0  rests
    11 7f    0  backward     127    0  0  moves
    00       0  stopped      127    0  0  rests
    70       0  rotate_left  127    0  0  moves
    00       0  stopped      127    0  0  rests
    20       0  forward      127    0  0  moves
    11 ff    0  forward      255    0  0  moves
    91 02    1  stopped      255    0  0  rests
""")

RULE_SEQUENCES = _sequences("""
at power-on a direction does not move | R-power-on
    20       0  forward        0    0  0  rests

at power-on Speed does not move | R-power-on
    11 ff    0  stopped      255    0  0  rests

Stop keeps the speed and resets steering | R-stop-steering, R-stop-speed
    11 c8    0  stopped      200    0  0  rests
    41 28    0  stopped      200   40  0  rests
    20       0  forward      200   40  0  moves
    00       0  stopped      200    0  0  rests
    20       0  forward      200    0  0  moves

Stop resets steering that was set while stopped | R-stop-steering
    51 ff    0  stopped        0 -255  0  rests
    00       0  stopped        0    0  0  rests

Stop leaves the LED as it is | R-led-state
    81 07    0  stopped        0    0  7  rests
    11 50    0  stopped       80    0  7  rests
    30       0  backward      80    0  7  moves
    00       0  stopped       80    0  7  rests
    81 00    0  stopped       80    0  0  rests

Stop ends each kind of motion | section 3, table 1
    11 64    0  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves
    00       0  stopped      100    0  0  rests
    30       0  backward     100    0  0  moves
    00       0  stopped      100    0  0  rests
    60       0  rotate_right 100    0  0  moves
    00       0  stopped      100    0  0  rests
    70       0  rotate_left  100    0  0  moves
    00       0  stopped      100    0  0  rests

one direction follows another without Stop | section 3, table 1
    11 64    0  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves
    30       0  backward     100    0  0  moves
    60       0  rotate_right 100    0  0  moves
    70       0  rotate_left  100    0  0  moves
    20       0  forward      100    0  0  moves

Speed while moving takes effect at once | R-speed-moving
    11 01    0  stopped        1    0  0  rests
    20       0  forward        1    0  0  moves
    11 ff    0  forward      255    0  0  moves
    30       0  backward     255    0  0  moves
    11 80    0  backward     128    0  0  moves
    60       0  rotate_right 128    0  0  moves
    11 40    0  rotate_right  64    0  0  moves
    70       0  rotate_left   64    0  0  moves
    11 20    0  rotate_left   32    0  0  moves

with speed 0 a direction is taken and does not move | R-speed-zero
    11 64    0  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves
    11 00    0  forward        0    0  0  rests
    30       0  backward       0    0  0  rests
    70       0  rotate_left    0    0  0  rests
    11 05    0  rotate_left    5    0  0  moves

Right after Left: the last one counts | R-steering
    11 64    0  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves
    51 50    0  forward      100  -80  0  moves
    41 1e    0  forward      100   30  0  moves
    51 ff    0  forward      100 -255  0  moves

strength 0 is straight on | R-steering
    11 64    0  stopped      100    0  0  rests
    30       0  backward     100    0  0  moves
    41 ff    0  backward     100  255  0  moves
    41 00    0  backward     100    0  0  moves
    51 ff    0  backward     100 -255  0  moves
    51 00    0  backward     100    0  0  moves

steering while stopped is remembered without moving | R-steering
    11 ff    0  stopped      255    0  0  rests
    41 3c    0  stopped      255   60  0  rests
    30       0  backward     255   60  0  moves

Forward and Backward keep the steering | R-drive-steering
    11 64    0  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves
    51 14    0  forward      100  -20  0  moves
    30       0  backward     100  -20  0  moves
    20       0  forward      100  -20  0  moves

rotations keep the steering | R-rotate-steering
    11 64    0  stopped      100    0  0  rests
    41 46    0  stopped      100   70  0  rests
    60       0  rotate_right 100   70  0  moves
    70       0  rotate_left  100   70  0  moves
    20       0  forward      100   70  0  moves

steering during a rotation is remembered, and it goes on rotating | R-steer-rotating
    11 64    0  stopped      100    0  0  rests
    60       0  rotate_right 100    0  0  moves
    51 0a    0  rotate_right 100  -10  0  moves
    70       0  rotate_left  100  -10  0  moves
    41 0b    0  rotate_left  100   11  0  moves
    30       0  backward     100   11  0  moves

the LED changes nothing else | section 3, table 1
    11 64    0  stopped      100    0  0  rests
    81 05    0  stopped      100    0  5  rests
    20       0  forward      100    0  5  moves
    41 09    0  forward      100    9  5  moves
    81 02    0  forward      100    9  2  moves
    70       0  rotate_left  100    9  2  moves
    81 00    0  rotate_left  100    9  0  moves

bad LED data leaves the LED as it was, and stops | R-led-upper-bits
    81 05    0  stopped        0    0  5  rests
    11 64    0  stopped      100    0  5  rests
    20       0  forward      100    0  5  moves
    81 0a    2  stopped      100    0  5  rests

a wrong Speed or Right does not take its data | section 2
    11 64    0  stopped      100    0  0  rests
    12 ff ff 3  stopped      100    0  0  rests
    42 ff ff 3  stopped      100    0  0  rests
    20       0  forward      100    0  0  moves

a fault resets steering that was set while stopped | R-fault-state
    41 ff    0  stopped        0  255  0  rests
    90       1  stopped        0    0  0  rests
""")

# One fault of each class.
FAULTS = (
    ("an unused ID", bytes.fromhex("90"), 1),
    ("the last unused ID", bytes.fromhex("f0"), 1),
    ("an unused ID with data", bytes.fromhex("91 02"), 1),
    ("too many data", bytes.fromhex("21 00"), 3),
    ("too few data", bytes.fromhex("10"), 4),
    ("bad LED data", bytes.fromhex("81 80"), 2),
    ("two LED bytes, the first out of range", bytes.fromhex("82 08 00"), 3),
    ("a known instruction cut short", bytes.fromhex("11"), 4),
    ("an unused ID cut short", bytes.fromhex("93 00"), 1),
    ("a cut-short instruction that announced too much", bytes.fromhex("12 05"), 4),
)

# Each kind of motion and the frame that starts it; None is standing still.
MOTIONS = (
    ("stopped", None),
    ("forward", bytes.fromhex("20")),
    ("backward", bytes.fromhex("30")),
    ("rotate_right", bytes.fromhex("60")),
    ("rotate_left", bytes.fromhex("70")),
)


def _in_motion(motion: str, start: bytes | None) -> tuple[Step, ...]:
    """Speed 200, LED 5, Left 30, and the motion."""
    steps = (
        _step("11 c8", 0, "stopped", 200, 0, 0, False),
        _step("81 05", 0, "stopped", 200, 0, 5, False),
        _step("51 1e", 0, "stopped", 200, -30, 5, False),
    )
    if start is None:
        return steps
    return (*steps, Step(start, 0, RobotState(motion, 200, -30, 5, True)))


# Section 2: a faulty instruction stops the robot at once. R-fault-state: steering is reset, speed
# and LED are kept, and only a direction makes it move again.
FAULT_SEQUENCES = (
    *(
        Sequence(
            f"{fault} while {motion}: Speed, LED and steering do not restart it",
            "section 2, R-fault-state, R-led-state",
            (
                *_in_motion(motion, start),
                Step(frame, code, RobotState("stopped", 200, 0, 5, False)),
                _step("11 5a", 0, "stopped", 90, 0, 5, False),
                _step("81 02", 0, "stopped", 90, 0, 2, False),
                _step("41 07", 0, "stopped", 90, 7, 2, False),
                _step("51 08", 0, "stopped", 90, -8, 2, False),
                _step("70", 0, "rotate_left", 90, -8, 2, True),
            ),
        )
        for motion, start in MOTIONS
        for fault, frame, code in FAULTS
    ),
)

SEQUENCES = (*DOCUMENT_SEQUENCES, *RULE_SEQUENCES, *FAULT_SEQUENCES)

# The document gives no mixing law: only signs, and which wheel is faster.
WHEELS = (
    WheelVector("stopped", 0, 0, 0, ""),
    WheelVector("stopped", 100, 0, 0, ""),
    WheelVector("forward", 0, 1, 1, ""),
    WheelVector("forward", 100, 1, 1, "left"),
    WheelVector("forward", -100, 1, 1, "right"),
    WheelVector("backward", 0, -1, -1, ""),
    WheelVector("backward", 100, -1, -1, "left"),
    WheelVector("backward", -100, -1, -1, "right"),
    WheelVector("rotate_right", 0, 1, -1, ""),
    WheelVector("rotate_right", 100, 1, -1, ""),
    WheelVector("rotate_right", -100, 1, -1, ""),
    WheelVector("rotate_left", 0, -1, 1, ""),
    WheelVector("rotate_left", 100, -1, 1, ""),
    WheelVector("rotate_left", -100, -1, 1, ""),
)

ERRATUM_IDS = ("E1", "E2", "E3", "E4", "E5", "E6")

# The errata that the bytes alone show: (erratum, section, line, as printed, as meant).
ERRATA_IN_BYTES = (
    ("E3", "5.2", 2, bytes([0b01000000, 0b11111111]), bytes([0b01000001, 0b11111111])),
    ("E5", "5.3", 8, bytes([0b10010001, 0b00000010]), bytes([0b10000001, 0b00000010])),
)

READING_IDS = (
    "R-unused-length", "R-known-length", "R-competing-errors", "R-led-upper-bits", "R-led-id",
    "R-example-right", "R-truncated-known", "R-truncated-unused", "R-truncated-long",
    "R-truncation-timeout", "R-answer-deadline", "R-stop-point", "R-stop-latency",
    "R-answer-point", "R-drain-known", "R-drain-unused", "R-pipelining", "R-fault-state",
    "R-stop-steering", "R-stop-speed", "R-drive-steering", "R-rotate-steering", "R-resolution",
    "R-steering", "R-steer-rotating", "R-speed-moving", "R-speed-zero", "R-led-state",
    "R-power-on", "R-unsolicited", "R-watchdog", "R-version", "R-line",
)  # fmt: skip
