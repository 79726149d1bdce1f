"""A relay board, framed as the car is: header byte, one answer byte."""

from construct import BitsInteger, BitStruct, Byte, Struct, Switch, this

from bilprov.spec.fields import (
    Answer,
    Answers,
    Bits,
    Changed,
    Clauses,
    From,
    Instruction,
    LineDefaults,
    Outcome,
    Ranged,
    Sets,
    Timing,
    Unknown,
    Variables,
    Whole,
    Word,
)

NAME = "relay-board"
VERSION = "1"
DOCUMENT = "a relay board"
DEVICE = "relay board"

STATE = Variables(
    relays=Bits("DCBA"), fan=Word("off", "low", "high"), level=Whole(-5, 5), on=Whole(0, 1)
)

HEADER = BitStruct("id" / BitsInteger(4), "length" / BitsInteger(4))

INSTRUCTIONS = {
    0: "Read" / Instruction(document="read") * "Does nothing.",
    1: "Relays"
    / Instruction(
        "mask" / Ranged(Byte, 0, 15, bits="DCBA") * "which are on",
        document="relays",
        effect=Sets(relays=From("mask")),
    )
    * "Switches all relays.",
    2: "High" / Instruction(document="fan", effect=Sets(fan="high")) * "Runs the fan.",
    3: "Off" / Instruction(document="fan off", effect=Sets(fan="off")) * "Stops the fan.",
    4: "Toggle"
    / Instruction(document="toggle", effect=Sets(on=Changed(-1, 1)))
    * "Switches it over.",
    5: "Up" / Instruction(document="up", effect=Sets(level=Changed(1, 1))) * "Raises the level.",
    6: "Pulse"
    / Instruction(document="pulse", effect=Sets(on=Unknown(), fan=Unknown()))
    * "For a moment.",
    7: "Store" / Instruction(document="store", changes="flash") * "Stores the state.",
}
FRAME = Struct("header" / HEADER, "data" / Switch(this.header.id, INSTRUCTIONS))

RESPONSE = Answers(
    Byte,
    {
        0: Answer("OK", Outcome.VALID, "", "done"),
        1: Answer("NO_ID", Outcome.UNKNOWN_ID, "", "unknown"),
        2: Answer("NO_DATA", Outcome.BAD_DATA, "", "bad data"),
        3: Answer("MANY", Outcome.TOO_MANY, "", "too many"),
        4: Answer("FEW", Outcome.TOO_FEW, "", "too few"),
    },
)
TIMING = Timing(
    truncation_timeout=50,
    truncation_shortest=1,
    truncation_longest=1000,
    answer_deadline=100,
    answer_longest=1000,
    stop_longest=100,
)
LINE = LineDefaults(baud=9600, parity="N", stopbits=1)
CLAUSES = Clauses(header="1", instructions="2", responses="3", safety="4")
