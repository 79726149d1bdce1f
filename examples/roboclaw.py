"""RoboClaw motor controllers, packet serial: a part of the commands of their user manual."""

from construct import Byte, Checksum, Int16ub, Pass, RawCopy, Struct, Switch, this

from bilprov.spec.fields import (
    Address,
    AllOf,
    Answer,
    Answers,
    Clauses,
    Crc,
    Data,
    From,
    Instruction,
    LineDefaults,
    Outcome,
    Ranged,
    Sets,
    Timing,
    Variables,
    Whole,
    asked,
)

NAME = "roboclaw"
VERSION = "4.2"
DOCUMENT = "RoboClaw Series Brushed DC Motor Controllers, User Manual, packet serial"
DEVICE = "motor controller"

SPEED = "speed" / Ranged(Byte, 0, 127) * "0 stops, 127 is full speed"
INSTRUCTIONS = {
    0: "ForwardM1"
    / Instruction(SPEED, document="0 - Drive Forward M1", effect=Sets(m1=From("speed")))
    * "Drives motor 1 forward.",
    1: "BackwardM1"
    / Instruction(
        SPEED, document="1 - Drive Backwards M1", effect=Sets(m1=From("speed", factor=-1))
    )
    * "Drives motor 1 backward.",
    4: "ForwardM2"
    / Instruction(SPEED, document="4 - Drive Forward M2", effect=Sets(m2=From("speed")))
    * "Drives motor 2 forward.",
    5: "BackwardM2"
    / Instruction(
        SPEED, document="5 - Drive Backwards M2", effect=Sets(m2=From("speed", factor=-1))
    )
    * "Drives motor 2 backward.",
    24: "MainBattery"
    / Instruction(
        document="24 - Read Main Battery Voltage Level",
        answer=Struct("voltage" / Int16ub * "tenths of a volt"),
    )
    * "Reads the voltage of the main battery.",
    49: "Currents"
    / Instruction(
        document="49 - Read Motor Currents",
        answer=Struct("m1" / Int16ub * "10 mA", "m2" / Int16ub * "10 mA"),
    )
    * "Reads the currents of both motors.",
}

CRC = Crc(16, 0x1021)
READS = {24: Pass, 49: Pass}  # which are sent without a check
FRAME = Struct(
    "covered"
    / RawCopy(
        Struct(
            "address" / Address(Byte, 0x80, 0x87) * "which controller",
            "id" / Byte * "which command",
            "data" / Switch(this.id, INSTRUCTIONS),
        )
    ),
    "crc" / Switch(this.covered.value.id, READS, default=Checksum(Int16ub, CRC, this.covered.data)),
)

# What reads is answered by data, whose check counts the request too; all else by one byte, FF. What
# the controller does not understand is not answered.
REPLY = Struct(
    "covered" / RawCopy(Struct("data" / Data())),
    "crc" / Checksum(Int16ub, CRC, asked.covered.data + this.covered.data),
)
RESPONSE = Answers(Byte, {0xFF: Answer("ACK", Outcome.VALID, "0xFF", "done")})
ACK = Struct("code" / RESPONSE)
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_DATA, Outcome.BAD_CHECKSUM)

STATE = Variables(m1=Whole(-127, 127), m2=Whole(-127, 127))
POWER_ON = Sets(m1=0, m2=0)
FAULTY = Sets()  # a bad packet changes nothing: both motors run on
AT_REST = AllOf(m1=0, m2=0)

TIMING = Timing(
    truncation_timeout=10,
    truncation_shortest=5,
    truncation_longest=100,
    answer_deadline=100,
    answer_longest=1000,
    stop_longest=100,
)
LINE = LineDefaults(baud=38400, parity="N", stopbits=1)
CLAUSES = Clauses(
    header="packet serial", instructions="commands", responses="commands", safety="none"
)
