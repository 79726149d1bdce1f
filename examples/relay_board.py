"""A USB relay board of the 55 56 kind: four relays, one request for each, nothing that moves."""

from construct import Byte, Checksum, Const, Enum, RawCopy, Struct, Switch, this

from bilprov.spec.fields import (
    Address,
    Changed,
    Clauses,
    Data,
    Instruction,
    LineDefaults,
    Outcome,
    Reports,
    Same,
    Sets,
    Sum,
    Timing,
    Unknown,
    Variables,
    Whole,
)

NAME = "relay-board"
VERSION = "1"
DOCUMENT = "4-channel relay board, 9600 8N1, frames 55 56"
DEVICE = "relay board"

STATUS = Struct(
    "state" / Reports("on", Enum(Byte, on=1, off=2), factor=-1, plus=2) * "what the relay is now"
)
INSTRUCTIONS = {
    0: "Read" / Instruction(document="read", answer=STATUS) * "Reports whether the relay is on.",
    1: "On"
    / Instruction(document="open", answer=STATUS, effect=Sets(on=1))
    * "Switches the relay on.",
    2: "Off"
    / Instruction(document="close", answer=STATUS, effect=Sets(on=0))
    * "Switches the relay off.",
    3: "Toggle"
    / Instruction(document="toggle", answer=STATUS, effect=Sets(on=Changed(-1, 1)))
    * "Switches the relay over.",
    4: "Pulse"
    / Instruction(document="momentary", answer=STATUS, effect=Sets(on=Unknown()))
    * "Switches the relay on for a moment.",
}

FRAME = Struct(
    "covered"
    / RawCopy(
        Struct(
            "sync" / Const(b"\x55\x56\x00\x00\x00"),
            "address" / Address(Byte, 1, 4) * "which relay",
            "id" / Byte * "what to do",
            "data" / Switch(this.id, INSTRUCTIONS),
        )
    ),
    "sum" / Checksum(Byte, Sum(8), this.covered.data),
)
REPLY = Struct(
    "covered"
    / RawCopy(
        Struct(
            "sync" / Const(b"\x33\x3c\x00\x00\x00"),
            "address" / Same("address", Byte) * "which relay",
            "data" / Data(),
        )
    ),
    "sum" / Checksum(Byte, Sum(8), this.covered.data),
)
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM)

STATE = Variables(on=Whole(0, 1))  # of each relay
POWER_ON = Sets(on=0)

TIMING = Timing(
    truncation_timeout=50,
    truncation_shortest=5,
    truncation_longest=1000,
    answer_deadline=100,
    answer_longest=1000,
    stop_longest=100,
)
LINE = LineDefaults(baud=9600, parity="N", stopbits=1)
CLAUSES = Clauses(header="frames", instructions="commands", responses="answers", safety="none")
