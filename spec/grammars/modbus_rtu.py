"""Modbus RTU: the common functions of coils and registers on a serial line.

A frame has no length and no mark at its end: the function tells how long it is, together with a
byte count where the number of values is free. `changes` marks the functions that write.
"""

from construct import (
    Byte,
    Checksum,
    Enum,
    GreedyBytes,
    GreedyRange,
    Int16ub,
    Int16ul,
    Prefixed,
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
    Crc,
    Data,
    Instruction,
    LineDefaults,
    Memory,
    Outcome,
    Ranged,
    Same,
    Timing,
)

NAME = "modbus-rtu"
VERSION = "1.1b3"
DOCUMENT = "MODBUS Application Protocol Specification V1.1b3, MODBUS over Serial Line V1.02"
DEVICE = "Modbus device"

# The fields of requests and answers. A byte count stands before coils, inputs and values.
START = "start" / Int16ub * "address of the first, from 0"
COIL = "coil" / Int16ub * "address of the coil, from 0"
REGISTER = "register" / Int16ub * "address of the register, from 0"
BITS = "quantity" / Ranged(Int16ub, 1, 2000) * "how many"
ASKED = "quantity" / Ranged(Int16ub, 1, 125) * "how many"
BITS_SENT = "quantity" / Ranged(Int16ub, 1, 1968) * "how many"
SENT = "quantity" / Ranged(Int16ub, 1, 123) * "how many"
COILS = "coils" / Prefixed(Byte, GreedyBytes) * "eight to a byte, the first in bit 0"
INPUTS = "inputs" / Prefixed(Byte, GreedyBytes) * "eight to a byte, the first in bit 0"
VALUES = "values" / Prefixed(Byte, GreedyRange(Int16ub)) * "one for each register"
SWITCH = "value" / Enum(Int16ub, off=0x0000, on=0xFF00) * "what the coil is set to"
VALUE = "value" / Int16ub * "what the register is set to"
TEST = "function" / Int16ub * "which test: 0 returns the word, 1 restarts, 4 makes silent"
WORD = "word" / Int16ub * "the data of the test"
AND_MASK = "and_mask" / Int16ub * "the bits that are kept"
OR_MASK = "or_mask" / Int16ub * "what the other bits become"
WORDS = "registers"
IDENTITY = "identity" / Prefixed(Byte, GreedyBytes) * "the device's own"
OUTPUTS = "status" / Byte * "eight outputs that the device chose"
BUSY = "status" / Enum(Int16ub, ready=0x0000, busy=0xFFFF) * "whether it is still at work"
EVENTS = "events" / Int16ub * "how many requests were carried out"
COIL_SET = Struct(COIL, SWITCH)
SET = Struct(REGISTER, VALUE)
MANY = Struct(START, "quantity" / Int16ub * "how many were written")
MASKED = Struct(REGISTER, AND_MASK, OR_MASK)

INSTRUCTIONS = {
    0x01: "ReadCoils" / Instruction(START, BITS, document="6.1", answer=Struct(COILS)),
    0x02: "ReadDiscreteInputs" / Instruction(START, BITS, document="6.2", answer=Struct(INPUTS)),
    0x03: "ReadHoldingRegisters" / Instruction(START, ASKED, document="6.3", answer=Struct(VALUES)),
    0x04: "ReadInputRegisters" / Instruction(START, ASKED, document="6.4", answer=Struct(VALUES)),
    0x05: "WriteSingleCoil"
    / Instruction(COIL, SWITCH, document="6.5", answer=COIL_SET, changes="coils"),
    0x06: "WriteSingleRegister"
    / Instruction(REGISTER, VALUE, document="6.6", answer=SET, changes=WORDS),
    0x07: "ReadExceptionStatus" / Instruction(document="6.7", answer=Struct(OUTPUTS)),
    0x08: "Diagnostics"
    / Instruction(TEST, WORD, document="6.8", answer=Struct(TEST, WORD), changes="communication"),
    0x0B: "GetCommEventCounter" / Instruction(document="6.9", answer=Struct(BUSY, EVENTS)),
    0x0F: "WriteMultipleCoils"
    / Instruction(START, BITS_SENT, COILS, document="6.11", answer=MANY, changes="coils"),
    0x10: "WriteMultipleRegisters"
    / Instruction(START, SENT, VALUES, document="6.12", answer=MANY, changes=WORDS),
    0x11: "ReportServerId" / Instruction(document="6.13", answer=Struct(IDENTITY)),
    0x16: "MaskWriteRegister"
    / Instruction(REGISTER, AND_MASK, OR_MASK, document="6.16", answer=MASKED, changes=WORDS),
    0x17: "ReadWriteMultipleRegisters"
    / Instruction(
        "read_start" / Int16ub * "address of the first to read, from 0",
        "read_quantity" / Ranged(Int16ub, 1, 125) * "how many are read",
        "write_start" / Int16ub * "address of the first to write, from 0",
        "write_quantity" / Ranged(Int16ub, 1, 121) * "how many are written",
        VALUES,
        document="6.17",
        answer=Struct(VALUES),
        changes=WORDS,
    ),
}

MEMORY = (
    Memory("coils", at="coil", value="value", bits=True),
    Memory("coils", at="start", value="coils", count="quantity", bits=True),
    Memory("inputs", at="start", value="inputs", count="quantity", bits=True),
    Memory("input", at="start", value="values", count="quantity", by=("ReadInputRegisters",)),
    Memory("holding", at="register", value="value"),
    Memory("holding", at="register", value="or_mask", keep="and_mask"),
    Memory("holding", at="start", value="values", count="quantity"),
    Memory("holding", at="read_start", value="values", count="read_quantity", only="reads"),
    Memory("holding", at="write_start", value="values", count="write_quantity"),
)
RESPONSE = Answers(
    Byte,
    {
        1: Answer("ILLEGAL_FUNCTION", Outcome.UNKNOWN_ID, "01", "there is no such function"),
        2: Answer("ILLEGAL_DATA_ADDRESS", (), "02", "the device has no such address"),
        3: Answer("ILLEGAL_DATA_VALUE", Outcome.BAD_DATA, "03", "a value is not allowed"),
        4: Answer("SERVER_DEVICE_FAILURE", (), "04", "the device failed while it worked"),
        5: Answer("ACKNOWLEDGE", (), "05", "accepted, but it takes long"),
        6: Answer("SERVER_DEVICE_BUSY", (), "06", "the device is busy; ask again later"),
        8: Answer("MEMORY_PARITY_ERROR", (), "08", "the device's memory is damaged"),
        10: Answer("GATEWAY_PATH_UNAVAILABLE", (), "0A", "the gateway has no path"),
        11: Answer("GATEWAY_TARGET_FAILED", (), "0B", "the device behind the gateway is silent"),
    },
)

ADDRESS = "address" / Address(Byte, 1, 247, broadcast=0) * "which device"
ANSWERED = "address" / Same("address", Byte)
CRC = "crc" / Checksum(Int16ul, Crc(16, 0x8005, 0xFFFF, reflected=True), this.covered.data)
REQUEST = Struct(ADDRESS, "id" / Byte * "function", "data" / Switch(this.id, INSTRUCTIONS))
RESULT = Struct(ANSWERED, "id" / Same("id", Byte), "data" / Data())
EXCEPTION = Struct(ANSWERED, "id" / Same("id", Byte, plus=0x80), "code" / RESPONSE)
FRAME = Struct("covered" / RawCopy(REQUEST), CRC)
REPLY = Struct("covered" / RawCopy(RESULT), CRC)
ERROR = Struct("covered" / RawCopy(EXCEPTION), CRC)
SILENT = (Outcome.BAD_CHECKSUM, Outcome.OTHER_ADDRESS, Outcome.TOO_FEW, Outcome.TOO_MANY)

# The document's 3.5 characters of silence are 2 ms; a host receives bytes up to 16 ms apart.
TIMING = Timing(
    truncation_timeout=50,
    truncation_shortest=1.75,
    truncation_longest=1000,
    answer_deadline=1000,
    answer_longest=5000,
    stop_longest=1000,
)
LINE = LineDefaults(baud=19200, parity="E", stopbits=1)
CLAUSES = Clauses("serial line 2.5.1", "6", "7", "serial line 2.4.1")
