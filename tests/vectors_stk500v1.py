"""Independent vectors of the STK500 protocol, version 1, typed by hand from the documents.

Nothing here is computed from the grammar and nothing of the kit is imported. Clauses are headings
of Atmel's application note AVR061 (2525B, 04/03), with its command.h of 2002 for the values;
"seen" marks frames that avrdude 7.1 and the bootloaders Optiboot and ATmegaBOOT exchange.
"""

from __future__ import annotations

from tests.frame_vectors import replies, requests

PAGE = "".join(f"{byte:02x}" for byte in range(128))  # the data of a page, 00 to 7F

REQUESTS = (
    *requests(r"""
30 20 | GetSync | - | Get Synchronization
31 20 | GetSignOn | - | Check if Starterkit Present
40 84 32 20 | SetParameter | parameter=0x84, value=50 | Set Parameter Value: VTARGET
41 81 20 | GetParameter | parameter=0x81 | Get Parameter Value: SW_MAJOR; seen
41 82 20 | GetParameter | parameter=0x82 | Get Parameter Value: SW_MINOR; seen
42 86 00 00 01 01 01 01 03 FF FF FF FF 0080 0400 00008000 20 |
    SetDevice | device=0x86, revision=0, progtype=0, parmode=1, polling=1, selftimed=1, lockbytes=1,
    fusebytes=3, flash_poll=0xFFFF, eeprom_poll=0xFFFF, page_size=128, eeprom_size=1024,
    flash_size=32768 | Set Device Programming Parameters; seen
45 05 04 D7 C2 01 20 |
    SetDeviceExt | eeprom_page_size=4, pagel=0xD7, bs2=0xC2, reset_disable=1 |
    Set Extended Device Programming Parameters; seen
50 20 | EnterProgmode | - | Enter Program Mode
51 20 | LeaveProgmode | - | Leave Program Mode
52 20 | ChipErase | - | Chip Erase
53 20 | CheckAutoinc | - | Check for Address Autoincrement
55 C0 00 20 | LoadAddress | address=0x00C0 | Load Address: low byte first; seen
55 00 3E 20 | LoadAddress | address=0x3E00 | Load Address: low byte first; seen
56 AC 80 00 00 20 | Universal | command=b"\xac\x80\x00\x00" | Universal Command: chip erase by ISP
60 34 12 20 | ProgFlash | word=0x1234 | Program Flash Memory
61 5A 20 | ProgData | value=0x5A | Program Data Memory
64 0004 45 A1 20 A3 20 20 |
    ProgPage | size=4, memory="eeprom", content=b"\xa1\x20\xa3\x20" |
    Program Page: 4 bytes of EEPROM; an end mark among the data
70 20 | ReadFlash | - | Read Flash Memory
71 20 | ReadData | - | Read Data Memory
72 20 | ReadFuse | - | Read Fuse Bits
73 20 | ReadLock | - | Read Lock Bits
74 0080 46 20 | ReadPage | size=128, memory="flash" | Read Page: 128 bytes of flash; seen
74 0004 45 20 | ReadPage | size=4, memory="eeprom" | Read Page: EEPROM
75 20 | ReadSign | - | Read Signature Bytes; seen
76 20 | ReadOsccal | - | Read Oscillator Calibration Byte
77 20 | ReadFuseExt | - | Read Fuse Bits Extended
# Faulty requests.
99 20 | unknown-id: | - | Unknown: directly followed by the end mark
30 21 | bad-sync: GetSync | - | Nosync: another byte in place of the end mark
75 21 | bad-sync: ReadSign | - | Nosync: another byte in place of the end mark
74 0101 46 20 | bad-data: ReadPage | - | Program Page: at most 256 bytes
74 0010 58 20 | bad-data: ReadPage | - | Read Page: memory X
30 | truncated: GetSync | - | Get Synchronization: cut short
64 0004 46 01 02 | truncated: ProgPage | - | Program Page: cut inside the data
42 8600 0001 | truncated: SetDevice | - | Set Device: one byte short
"""),
    *requests(f"""
64 0080 46 {PAGE} 20 |
    ProgPage |
    size=128, memory="flash", content={bytes(range(128))} | Program Page: 128 bytes of flash
"""),
)

REPLIES = (
    *replies(r"""
30 20 > 14 10 | OK | - | Get Synchronization; seen
31 20 > 14 4156522053544B 10 | OK | - | Check if Starterkit Present; seen
41 81 20 > 14 08 10 | OK | value=8 | Get Parameter Value; seen
41 82 20 > 14 10 10 | OK | value=16 | Get Parameter Value; seen
55 C0 00 20 > 14 10 | OK | - | Load Address; seen
56 30 00 00 00 20 > 14 1E 10 | OK | output=0x1E | Universal Command; seen
70 20 > 14 34 12 10 | OK | word=0x1234 | Read Flash Memory
71 20 > 14 5A 10 | OK | value=0x5A | Read Data Memory
72 20 > 14 FF DE 10 | OK | low=0xFF, high=0xDE | Read Fuse Bits
73 20 > 14 CF 10 | OK | lock=0xCF | Read Lock Bits
74 0004 45 20 > 14 A1 10 14 10 10 |
    OK | content=b"\xa1\x10\x14\x10" | Read Page: its end is known by the request; seen
75 20 > 14 1E 95 0F 10 | OK | signature=b"\x1e\x95\x0f" | Read Signature Bytes; seen
76 20 > 14 00 10 | OK | value=0 | Read Oscillator Calibration Byte; seen
77 20 > 14 FF DE 05 10 | OK | low=255, high=0xDE, extended=5 | Read Fuse Bits Extended
# Answers to what fails.
50 20 > 14 13 | NODEVICE | - | Enter Program Mode: no device was set
53 20 > 14 11 | FAILED | - | Check for Address Autoincrement: no
41 07 20 > 14 07 11 | FAILED | value=7 | Get Parameter Value: no such parameter
30 21 > 15 | NOSYNC | - | Nosync
99 20 > 12 | UNKNOWN | - | Unknown
"""),
    *replies(f"64 0080 46 {PAGE} 20 > 14 10 | OK | - | Program Page"),
)
