"""Independent vectors of DYNAMIXEL Protocol 1.0 and Feetech SCS, typed by hand from the documents.

Nothing here is computed from the grammar and nothing of the kit is imported. Clauses without a
title are headings of the ROBOTIS e-Manual, "Protocol 1.0"; "AX-12" is the user's manual of the
AX-12 (2006), "SCS" the communication protocol of the Feetech SCS and STS servos.
"""

from __future__ import annotations

from tests.frame_vectors import replies, requests

REQUESTS = requests(r"""
FFFF 01 02 01 FB | Ping | to=1 | Ping, example
FFFF 03 02 01 F9 | Ping | to=3 | SCS: ping, example
FFFF 01 04 02 2B 01 CC | Read | to=1, register=0x2B, size=1 | Read, example
FFFF 01 04 02 00 03 F5 | Read | to=1, register=0, size=3 | AX-12: model and version
FFFF 01 04 02 38 02 BE | Read | to=1, register=0x38, size=2 | SCS: present position, example
FFFF 01 05 03 0C 64 AA DC |
    Write | to=1, register=12, values=b"\x64\xaa" | Instruction Checksum, example
FFFF 01 04 03 03 00 F4 | Write | to=1, register=3, values=b"\x00" | AX-12: ID 0 for ID 1
FFFF 00 04 03 05 02 F1 | Write | to=0, register=5, values=b"\x02" | AX-12: return delay of 4 us
FFFF 00 05 03 08 FF 01 EF |
    Write | to=0, register=8, values=b"\xff\x01" | AX-12: angle limit of 150 degrees
FFFF 00 05 03 18 01 01 DD | Write | to=0, register=24, values=b"\x01\x01" | AX-12: LED and torque on
FFFF 00 07 03 1A 01 01 40 40 59 |
    Write | to=0, register=26, values=b"\x01\x01\x40\x40" | AX-12: compliance margin and slope
FFFF 00 07 03 1E 00 02 00 02 D3 |
    Write | to=0, register=30, values=b"\x00\x02\x00\x02" | AX-12: position 180 degrees at 57 RPM
FFFF 01 09 03 2A 00 08 00 00 E8 03 D5 |
    Write |
    to=1, register=0x2A, values=b"\x00\x08\x00\x00\xe8\x03" | SCS: position 2048, time 0, speed 1000
FFFF 01 05 04 1E F4 01 E2 | RegWrite | to=1, register=30, values=b"\xf4\x01" | Reg Write, example
FFFF 00 05 04 1E 00 00 D8 |
    RegWrite | to=0, register=30, values=b"\x00\x00" | AX-12: reg write of position 0
FFFF 00 02 06 F7 | Reset | to=0 | Factory Reset, example
# Broadcast: ID 254, every servo acts and none answers.
FFFF FE 04 03 03 01 F6 | Write | to=254, register=3, values=b"\x01" | Write, example: broadcast
FFFF FE 02 05 FA | Action | to=254 | Action, example: broadcast
FFFF FE 0E 83 1E 04 00 10 00 50 01 01 20 02 60 03 67 |
    SyncWrite | to=254, register=30, size=4, blocks=b"\x00\x10\x00\x50\x01\x01\x20\x02\x60\x03" |
    Sync Write, example: broadcast
FFFF FE 18 83 1E 04 00 10 00 50 01 01 20 02 60 03 02 30 00 70 01 03 20 02 80 03 12 |
    SyncWrite | to=254, register=30, size=4, blocks=b"\x00\x10\x00\x50\x01\x01\x20\x02\x60\x03"
    b"\x02\x30\x00\x70\x01\x03\x20\x02\x80\x03" | AX-12: sync write of four servos
# Faulty instruction packets.
FFFF 01 02 99 63 | unknown-id: | to=1 | Error, bit 6: undefined instruction
FFFF 01 02 01 FA | bad-checksum: Ping | to=1 | Error, bit 4: checksum
FFFF 01 05 03 0C 64 AA 23 |
    bad-checksum: Write | to=1 | Instruction Checksum: the sum without its complement
FFFF 01 03 01 00 FA | too-many: Ping | to=1 | Length: a ping with a parameter
FFFF 01 03 02 2B CE | too-few: Read | to=1 | Length: a read without its size
FFFE 01 02 01 FB | bad-sync: | - | Header: one byte differs
FFFF 01 04 | truncated: | to=1 | Packet: cut behind the length
FFFF 01 04 02 2B 01 | truncated: Read | to=1 | Packet: without its checksum
""")

REPLIES = replies(r"""
FFFF 01 02 01 FB > FFFF 01 02 00 FC | OK | - | Ping, example
FFFF 01 04 02 2B 01 CC > FFFF 01 03 00 20 DB | OK | values=b"\x20" | Read, example
FFFF 01 04 02 00 03 F5 > FFFF 01 05 00 74 00 08 7D |
    OK | values=b"\x74\x00\x08" | AX-12: model and version
FFFF 01 04 02 38 02 BE > FFFF 01 04 00 18 05 DD |
    OK | values=b"\x18\x05" | SCS: present position, example
FFFF 01 05 04 1E F4 01 E2 > FFFF 01 02 00 FC | OK | - | Reg Write, example
FFFF 00 02 06 F7 > FFFF 00 02 00 FD | OK | - | Factory Reset, example
FFFF 00 05 03 30 40 00 87 > FFFF 00 02 08 F5 | RANGE | - | AX-12: register is locked
FFFF 01 02 01 FB > FFFF 01 02 24 D8 | OVERLOAD OVERHEATING | - | Error, example: two bits
FFFF 01 02 99 63 > FFFF 01 02 40 BC | INSTRUCTION | - | Error, bit 6
FFFF 01 02 01 FA > FFFF 01 02 10 EC | CHECKSUM | - | Error, bit 4
""")
