"""DYNAMIXEL Protocol 1.0, which Feetech's SCS and STS servos speak too.

Registers are bytes here: which of them belong together, and in which order, differs from servo to
servo. Left out are instructions that several servos answer (sync read, bulk read).
"""

from construct import (
    Byte,
    Bytes,
    Checksum,
    Const,
    FixedSized,
    GreedyBytes,
    RawCopy,
    Struct,
    Switch,
    this,
)

from bilprov.spec.fields import (
    Address,
    Answer,
    Answers,
    Clauses,
    Data,
    Instruction,
    Length,
    LineDefaults,
    Memory,
    Outcome,
    Same,
    Sum,
    Timing,
    asked,
)

NAME = "dynamixel1"
VERSION = "1.0"
DOCUMENT = "ROBOTIS e-Manual, DYNAMIXEL Protocol 1.0"
DEVICE = "servo"

REGISTER = "register" / Byte * "address of the first byte"
VALUES = "values" / GreedyBytes * "the bytes, in ascending order of their addresses"

INSTRUCTIONS = {
    0x01: "Ping" / Instruction(document="Ping") * "Asks whether the servo is there.",
    0x02: "Read"
    / Instruction(
        REGISTER,
        "size" / Byte * "number of bytes",
        document="Read",
        answer=Struct("values" / Bytes(asked.size) * "the bytes"),
    )
    * "Reads registers.",
    0x03: "Write"
    / Instruction(REGISTER, VALUES, document="Write", changes="registers")
    * "Writes registers; the servo may move.",
    0x04: "RegWrite"
    / Instruction(REGISTER, VALUES, document="Reg Write", changes="registers")
    * "Has registers written by the next Action.",
    0x05: "Action"
    / Instruction(document="Action", changes="registers")
    * "Carries out what RegWrite asked for; the servo may move.",
    0x06: "Reset"
    / Instruction(document="Factory Reset", changes="registers")
    * "Sets every register to its factory default, the servo's ID too.",
    0x83: "SyncWrite"
    / Instruction(
        REGISTER,
        "size" / Byte * "number of bytes for each servo",
        "blocks" / GreedyBytes * "for each servo its ID and its bytes",
        document="Sync Write",
        answer=None,
        changes="registers",
    )
    * "Writes the same registers of several servos, which may move.",
}

UNDONE = "INSTRUCTION"
MEMORY = (
    Memory("registers", at="register", value="values", count="size", by=("Read", "Write")),
    Memory(
        "registers", at="register", value="values", by=("RegWrite",), until="Action", code=UNDONE
    ),
    Memory("registers", at="register", value="blocks", count="size", blocks=True, reset="Reset"),
)
RESPONSE = Answers(
    Byte,
    {
        0x00: Answer("OK", Outcome.VALID, "0", "no error"),
        0x01: Answer("INPUT_VOLTAGE", (), "Input Voltage Error", "voltage out of its range"),
        0x02: Answer("ANGLE_LIMIT", (), "Angle Limit Error", "goal position out of its limits"),
        0x04: Answer("OVERHEATING", (), "Overheating Error", "too hot"),
        0x08: Answer("RANGE", (), "Range Error", "a value is out of its range"),
        0x10: Answer("CHECKSUM", Outcome.BAD_CHECKSUM, "Checksum Error", "wrong checksum"),
        0x20: Answer("OVERLOAD", (), "Overload Error", "the load is too high for the torque"),
        0x40: Answer(
            "INSTRUCTION",
            (Outcome.UNKNOWN_ID, Outcome.TOO_FEW, Outcome.TOO_MANY),
            "Instruction Error",
            "undefined instruction, or an Action without a RegWrite",
        ),
    },
    flags=True,
)

SYNC = "sync" / Const(b"\xff\xff") * "Header"
ADDRESS = "address" / Address(Byte, 0, 253, broadcast=254) * "which servo"
LENGTH = "length" / Length(Byte, also=2) * "of what follows it"
SAME = "address" / Same("address", Byte)
CHECK = "sum" / Checksum(Byte, Sum(8, complement=True), this.covered.data)
ASKED = FixedSized(this.length, Switch(this.id, INSTRUCTIONS))
TOLD = FixedSized(this.length, Data())

FRAME = Struct(
    SYNC,
    "covered" / RawCopy(Struct(ADDRESS, LENGTH, "id" / Byte * "instruction", "data" / ASKED)),
    CHECK,
)
REPLY = Struct(
    SYNC,
    "covered" / RawCopy(Struct(SAME, LENGTH, "code" / RESPONSE, "data" / TOLD)),
    CHECK,
)
ERROR = Struct(SYNC, "covered" / RawCopy(Struct(SAME, LENGTH, "code" / RESPONSE)), CHECK)
SILENT = (Outcome.BAD_SYNC, Outcome.OTHER_ADDRESS)

TIMING = Timing(
    truncation_timeout=100,  # Byte to Byte Time
    truncation_shortest=5,
    truncation_longest=1000,
    answer_deadline=50,
    answer_longest=1000,
    stop_longest=1000,
)
LINE = LineDefaults(baud=1000000, parity="N", stopbits=1)
CLAUSES = Clauses(
    header="Instruction Packet", instructions="Instruction Details", responses="Error", safety="ID"
)
