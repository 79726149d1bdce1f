"""Independent vectors of Modbus RTU, typed by hand from the documents.

Nothing here is computed from the grammar and nothing of the kit is imported. Clauses without a
title are of the Modbus Application Protocol Specification V1.1b3, whose worked examples leave out
address and CRC; "serial line" is the Modbus over Serial Line Specification V1.02, and "worked
frames" are the examples with address and CRC that many vendors print (unit 17 and unit 10).
"""

from __future__ import annotations

from tests.frame_vectors import replies, requests

REQUESTS = requests(r"""
11 01 0013 0025 0E84 | ReadCoils | to=17, start=19, quantity=37 | 6.1; worked frames, FC 01
11 02 00C4 0016 BAA9 |
    ReadDiscreteInputs | to=17, start=196, quantity=22 | 6.2; worked frames, FC 02
11 03 006B 0003 7687 |
    ReadHoldingRegisters | to=17, start=107, quantity=3 | 6.3; worked frames, FC 03
11 04 0008 0001 B298 | ReadInputRegisters | to=17, start=8, quantity=1 | 6.4; worked frames, FC 04
11 05 00AC FF00 4E8B | WriteSingleCoil | to=17, coil=172, value="on" | 6.5; worked frames, FC 05
11 05 00AC 0000 0F7B | WriteSingleCoil | to=17, coil=172, value="off" | 6.5: 0000 is off
11 06 0001 0003 9A9B | WriteSingleRegister | to=17, register=1, value=3 | 6.6; worked frames, FC 06
11 07 4C22 | ReadExceptionStatus | to=17 | 6.7
02 07 4112 | ReadExceptionStatus | to=2 | serial line 6.2.2
11 08 0000 A537 D81D | Diagnostics | to=17, function=0, word=0xA537 | 6.8.1 sub-function 00
11 0B 4C27 | GetCommEventCounter | to=17 | 6.9
11 0F 0013 000A 02 CD01 BF0B |
    WriteMultipleCoils |
    to=17, start=19, quantity=10, coils=b"\xcd\x01" | 6.11; worked frames, FC 15
11 10 0001 0002 04 000A 0102 C6F0 |
    WriteMultipleRegisters |
    to=17, start=1, quantity=2, values=[0x000A, 0x0102] | 6.12; worked frames, FC 16
11 11 CDEC | ReportServerId | to=17 | 6.13
11 16 0004 00F2 0025 66E2 |
    MaskWriteRegister | to=17, register=4, and_mask=0x00F2, or_mask=0x0025 | 6.16
11 17 0003 0006 000E 0003 06 00FF 00FF 00FF 4B54 |
    ReadWriteMultipleRegisters |
    to=17, read_start=3, read_quantity=6, write_start=14, write_quantity=3, values=[255, 255, 255] |
    6.17
# Broadcast: address 0, everybody acts and nobody answers.
00 06 0028 BEEF 383F |
    WriteSingleRegister | to=0, register=40, value=0xBEEF | serial line 2.1: broadcast
00 10 0028 0002 04 CAFE BABE 59D5 |
    WriteMultipleRegisters |
    to=0, start=40, quantity=2, values=[0xCAFE, 0xBABE] | serial line 2.1: broadcast
# Faulty requests.
11 41 CDD0 | unknown-id: | to=17 | 6, figure 9: unknown function
11 05 0028 0001 8E92 | bad-data: WriteSingleCoil | to=17 | 6.5: only 0000 and FF00
11 03 0000 007E C77A | bad-data: ReadHoldingRegisters | to=17 | 6.3: at most 125
11 03 0000 0000 475A | bad-data: ReadHoldingRegisters | to=17 | 6.3: at least 1
11 01 0000 07D1 FCF6 | bad-data: ReadCoils | to=17 | 6.1: at most 2000
11 0F 0000 0000 00 1AFE | bad-data: WriteMultipleCoils | to=17 | 6.11: at least 1
11 03 006B 0003 8776 |
    bad-checksum: ReadHoldingRegisters | to=17 | serial line 2.5.1.2: CRC of the other byte order
11 06 0001 0002 9A9B |
    bad-checksum: WriteSingleRegister | to=17 | serial line 2.5.1.2: one bit of the data differs
11 03 006B | truncated: ReadHoldingRegisters | to=17 | serial line 2.5.1.1: incomplete
11 10 0001 0002 04 000A |
    truncated: WriteMultipleRegisters | to=17 | serial line 2.5.1.1: cut inside the values
11 04 0008 0001 | truncated: ReadInputRegisters | to=17 | serial line 2.5.1.1: no CRC
""")

REPLIES = replies(r"""
11 01 0013 0025 0E84 > 11 01 05 CD6BB20E1B 45E6 |
    - | coils=b"\xcd\x6b\xb2\x0e\x1b" | 6.1; worked frames, FC 01
11 02 00C4 0016 BAA9 > 11 02 03 ACDB35 2018 | - | inputs=b"\xac\xdb\x35" | 6.2; worked frames, FC 02
11 03 006B 0003 7687 > 11 03 06 AE41 5652 4340 49AD |
    - | values=[0xAE41, 0x5652, 0x4340] | 6.3; worked frames, FC 03
11 04 0008 0001 B298 > 11 04 02 000A F8F4 | - | values=[0x000A] | 6.4; worked frames, FC 04
11 05 00AC FF00 4E8B > 11 05 00AC FF00 4E8B | - | coil=172, value="on" | 6.5; worked frames, FC 05
11 06 0001 0003 9A9B > 11 06 0001 0003 9A9B | - | register=1, value=3 | 6.6; worked frames, FC 06
11 07 4C22 > 11 07 6D E218 | - | status=0x6D | 6.7
11 08 0000 A537 D81D > 11 08 0000 A537 D81D | - | function=0, word=0xA537 | 6.8.1 sub-function 00
11 0B 4C27 > 11 0B FFFF 0108 A6E9 | - | status="busy", events=0x0108 | 6.9
11 0F 0013 000A 02 CD01 BF0B > 11 0F 0013 000A 2699 |
    - | start=19, quantity=10 | 6.11; worked frames, FC 15
11 10 0001 0002 04 000A 0102 C6F0 > 11 10 0001 0002 1298 |
    - | start=1, quantity=2 | 6.12; worked frames, FC 16
11 11 CDEC > 11 11 08 562D502D312E30FF 83BF |
    - | identity=b"V-P-1.0\xff" | 6.13: what a server reports is its own
11 16 0004 00F2 0025 66E2 > 11 16 0004 00F2 0025 66E2 |
    - | register=4, and_mask=0x00F2, or_mask=0x0025 | 6.16
11 17 0003 0006 000E 0003 06 00FF 00FF 00FF 4B54 > 11 17 0C 00FE 0ACD 0001 0003 000D 00FF 0D75 |
    - | values=[0x00FE, 0x0ACD, 1, 3, 13, 255] | 6.17
# Exceptions: the function with bit 7 set, and a code (section 7).
0A 01 04A1 0001 AC63 > 0A 81 02 B053 | ILLEGAL_DATA_ADDRESS | - | 7; worked frames, exception
11 41 CDD0 > 11 C1 01 B195 | ILLEGAL_FUNCTION | - | 7: code 01
11 05 0028 0001 8E92 > 11 85 03 0354 | ILLEGAL_DATA_VALUE | - | 7: code 03
11 03 0000 007E C77A > 11 83 03 00F4 | ILLEGAL_DATA_VALUE | - | 7: code 03
11 06 0001 0003 9A9B > 11 86 04 4266 | SERVER_DEVICE_FAILURE | - | 7: code 04
11 03 006B 0003 7687 > 11 83 05 80F6 | ACKNOWLEDGE | - | 7: code 05
11 03 006B 0003 7687 > 11 83 06 C0F7 | SERVER_DEVICE_BUSY | - | 7: code 06
11 03 006B 0003 7687 > 11 83 08 4133 | MEMORY_PARITY_ERROR | - | 7: code 08
""")
