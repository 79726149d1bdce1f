"""The STK500 protocol, version 1, as avrdude speaks it and Arduino's bootloaders answer.

A frame has no length, sync or checksum: its command tells how long it is, and 20 ends it. The end
of a page that is read is known only by the request. Left out are commands that no bootloader has,
the sizes of SET_DEVICE_EXT other than today's five bytes, and the answer to a refused
SET_PARAMETER, which has a byte more than the others.
"""

from construct import Byte, Bytes, Const, Enum, Int16ub, Int16ul, Int32ub, Struct, Switch, this

from bilprov.spec.fields import (
    Answer,
    Answers,
    Clauses,
    Data,
    Instruction,
    LineDefaults,
    Memory,
    Outcome,
    Ranged,
    Timing,
    asked,
)

NAME = "stk500v1"
VERSION = "1"
DOCUMENT = "AVR061: STK500 Communication Protocol, Atmel, 2525B, 04/03"
DEVICE = "bootloader"

PARAMETER = "parameter" / Byte * "which one: 81 and 82 are the version"
SIZE = "size" / Ranged(Int16ub, 1, 256) * "number of bytes"
KIND = "memory" / Enum(Byte, flash=0x46, eeprom=0x45) * "which memory"
VALUE = "value" / Byte * "the byte"
WORD = "word" / Int16ul * "the word"
LOW = "low" / Byte * "low fuses"
HIGH = "high" / Byte * "high fuses"
EXTENDED = "extended" / Byte * "extended fuses"
CONTENT = "content" / Bytes(this.size) * "what is written"
SIGN_ON = Struct("message" / Const(b"AVR STK") * "always the same")
PAGE = Struct("content" / Bytes(asked.size) * "what was read")
SIGNATURE = Struct("signature" / Bytes(3) * "of the microcontroller")

INSTRUCTIONS = {
    0x30: "GetSync" / Instruction(document="Get Synchronization"),
    0x31: "GetSignOn" / Instruction(document="Check if Starterkit Present", answer=SIGN_ON),
    0x40: "SetParameter"
    / Instruction(PARAMETER, VALUE, document="Set Parameter Value", changes="parameters"),
    0x41: "GetParameter"
    / Instruction(PARAMETER, document="Get Parameter Value", answer=Struct(VALUE)),
    0x42: "SetDevice"
    / Instruction(
        "device" / Byte * "code of the microcontroller",
        "revision" / Byte * "not used",
        "progtype" / Byte * "0 parallel and serial, 1 parallel only",
        "parmode" / Byte * "0 pseudo parallel, 1 full parallel interface",
        "polling" / Byte * "1 may be polled",
        "selftimed" / Byte * "1 times itself",
        "lockbytes" / Byte * "number of lock bytes",
        "fusebytes" / Byte * "number of fuse bytes",
        "flash_poll" / Int16ub * "the same polling value twice",
        "eeprom_poll" / Int16ub * "two polling values",
        "page_size" / Int16ub * "bytes of a page",
        "eeprom_size" / Int16ub * "bytes of EEPROM",
        "flash_size" / Int32ub * "bytes of flash",
        document="Set Device Programming Parameters",
    ),
    0x45: "SetDeviceExt"
    / Instruction(
        "size" / Const(b"\x05") * "number of these bytes",
        "eeprom_page_size" / Byte * "bytes of a page",
        "pagel" / Byte * "pin of the signal PAGEL",
        "bs2" / Byte * "pin of the signal BS2",
        "reset_disable" / Byte * "1 has a fuse for it",
        document="Set Extended Device Programming Parameters",
    ),
    0x50: "EnterProgmode" / Instruction(document="Enter Program Mode", changes="programming mode"),
    0x51: "LeaveProgmode" / Instruction(document="Leave Program Mode", changes="programming mode"),
    0x52: "ChipErase" / Instruction(document="Chip Erase", changes="flash"),
    0x53: "CheckAutoinc" / Instruction(document="Check for Address Autoincrement"),
    0x55: "LoadAddress"
    / Instruction("address" / Int16ul * "in words for flash", document="Load Address")
    * "Sets the address of what is read or written next.",
    0x56: "Universal"
    / Instruction(
        "command" / Bytes(4) * "a command of the microcontroller's serial programming",
        document="Universal Command",
        answer=Struct("output" / Byte * "its last byte of output"),
        changes="flash or fuses",
    ),
    0x60: "ProgFlash" / Instruction(WORD, document="Program Flash Memory", changes="flash"),
    0x61: "ProgData" / Instruction(VALUE, document="Program Data Memory", changes="EEPROM"),
    0x64: "ProgPage"
    / Instruction(SIZE, KIND, CONTENT, document="Program Page", changes="flash or EEPROM"),
    0x70: "ReadFlash" / Instruction(document="Read Flash Memory", answer=Struct(WORD)),
    0x71: "ReadData" / Instruction(document="Read Data Memory", answer=Struct(VALUE)),
    0x72: "ReadFuse" / Instruction(document="Read Fuse Bits", answer=Struct(LOW, HIGH)),
    0x73: "ReadLock"
    / Instruction(document="Read Lock Bits", answer=Struct("lock" / Byte * "lock bits")),
    0x74: "ReadPage" / Instruction(SIZE, KIND, document="Read Page", answer=PAGE),
    0x75: "ReadSign" / Instruction(document="Read Signature Bytes", answer=SIGNATURE),
    0x76: "ReadOsccal"
    / Instruction(document="Read Oscillator Calibration Byte", answer=Struct(VALUE)),
    0x77: "ReadFuseExt"
    / Instruction(document="Read Fuse Bits Extended", answer=Struct(LOW, HIGH, EXTENDED)),
}

# Pages of words of flash, or of bytes of EEPROM, at the address that was loaded. A simulated
# device is an ATmega328P whose firmware has the version 1.16. Of serial programming it knows the
# command 30, which reads the signature.
READ_SIGNATURE = {0x30000000: 0x1E, 0x30000100: 0x95, 0x30000200: 0x0F}
MEMORY = (
    Memory("parameters", at="parameter", value="value", power_on={0x81: 1, 0x82: 16}),
    Memory("signature", value="signature", power_on={0: 0x1E, 1: 0x95, 2: 0x0F}),
    Memory("serial", at="command", value="output", power_on=READ_SIGNATURE),
    Memory("p", at="address", value="content", count="size", factor=2, of="memory", latest=True),
)
RESPONSE = Answers(
    Byte,
    {
        0x10: Answer("OK", Outcome.VALID, "Resp_STK_OK", "done"),
        0x11: Answer("FAILED", Outcome.BAD_DATA, "Resp_STK_FAILED", "it could not be done"),
        0x12: Answer("UNKNOWN", Outcome.UNKNOWN_ID, "Resp_STK_UNKNOWN", "no such command"),
        0x13: Answer("NODEVICE", (), "Resp_STK_NODEVICE", "no microcontroller was described"),
        0x15: Answer("NOSYNC", Outcome.BAD_SYNC, "Resp_STK_NOSYNC", "20 was expected at the end"),
    },
)
FRAME = Struct(
    "id" / Byte * "which command",
    "data" / Switch(this.id, INSTRUCTIONS),
    "end" / Const(b"\x20") * "Sync_CRC_EOP",
)
REPLY = Struct("insync" / Const(b"\x14"), "data" / Data(), "code" / RESPONSE)
ERROR = Struct("code" / RESPONSE)  # without 14 in front
SILENT = (Outcome.TOO_FEW,)

# A bootloader waits a second for the rest of a frame, then starts the program; a page takes up to
# half a second to be written.
TIMING = Timing(
    truncation_timeout=1000,
    truncation_shortest=500,
    truncation_longest=2000,
    answer_deadline=500,
    answer_longest=5000,
    stop_longest=1000,
)
LINE = LineDefaults(baud=115200, parity="N", stopbits=1)
DEFINED = "Command Definitions"
CLAUSES = Clauses(DEFINED, DEFINED, "Response Definitions", DEFINED)
