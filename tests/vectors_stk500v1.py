"""Independent vectors of the STK500 protocol, version 1, typed by hand from the documents.

Nothing here is computed from the grammar and nothing of the kit is imported. Clauses are headings
of Atmel's application note AVR061 (2525B, 04/03), with its command.h of 2002 for the values;
"seen" marks frames that avrdude 7.1 and the bootloaders Optiboot and ATmegaBOOT exchange.
"""

from __future__ import annotations

from tests.frame_vectors import reply, request

PAGE = "".join(f"{byte:02x}" for byte in range(128))  # the data of a page, 00 to 7F

REQUESTS = (
    request("Get Synchronization", "30 20", "GetSync"),
    request("Check if Starterkit Present", "31 20", "GetSignOn"),
    request(
        "Set Parameter Value: VTARGET", "40 84 32 20", "SetParameter", parameter=0x84, value=50
    ),
    request("Get Parameter Value: SW_MAJOR; seen", "41 81 20", "GetParameter", parameter=0x81),
    request("Get Parameter Value: SW_MINOR; seen", "41 82 20", "GetParameter", parameter=0x82),
    request(
        "Set Device Programming Parameters; seen",
        "42 86 00 00 01 01 01 01 03 FF FF FF FF 0080 0400 00008000 20",
        "SetDevice",
        device=0x86,
        revision=0,
        progtype=0,
        parmode=1,
        polling=1,
        selftimed=1,
        lockbytes=1,
        fusebytes=3,
        flash_poll=0xFFFF,
        eeprom_poll=0xFFFF,
        page_size=128,
        eeprom_size=1024,
        flash_size=32768,
    ),
    request(
        "Set Extended Device Programming Parameters; seen",
        "45 05 04 D7 C2 01 20",
        "SetDeviceExt",
        eeprom_page_size=4,
        pagel=0xD7,
        bs2=0xC2,
        reset_disable=1,
    ),
    request("Enter Program Mode", "50 20", "EnterProgmode"),
    request("Leave Program Mode", "51 20", "LeaveProgmode"),
    request("Chip Erase", "52 20", "ChipErase"),
    request("Check for Address Autoincrement", "53 20", "CheckAutoinc"),
    request("Load Address: low byte first; seen", "55 C0 00 20", "LoadAddress", address=0x00C0),
    request("Load Address: low byte first; seen", "55 00 3E 20", "LoadAddress", address=0x3E00),
    request(
        "Universal Command: chip erase by ISP",
        "56 AC 80 00 00 20",
        "Universal",
        command=b"\xac\x80\x00\x00",
    ),
    request("Program Flash Memory", "60 34 12 20", "ProgFlash", word=0x1234),
    request("Program Data Memory", "61 5A 20", "ProgData", value=0x5A),
    request(
        "Program Page: 128 bytes of flash",
        f"64 0080 46 {PAGE} 20",
        "ProgPage",
        size=128,
        memory="flash",
        content=bytes(range(128)),
    ),
    request(
        "Program Page: 4 bytes of EEPROM; an end mark among the data",
        "64 0004 45 A1 20 A3 20 20",
        "ProgPage",
        size=4,
        memory="eeprom",
        content=b"\xa1\x20\xa3\x20",
    ),
    request("Read Flash Memory", "70 20", "ReadFlash"),
    request("Read Data Memory", "71 20", "ReadData"),
    request("Read Fuse Bits", "72 20", "ReadFuse"),
    request("Read Lock Bits", "73 20", "ReadLock"),
    request(
        "Read Page: 128 bytes of flash; seen",
        "74 0080 46 20",
        "ReadPage",
        size=128,
        memory="flash",
    ),
    request("Read Page: EEPROM", "74 0004 45 20", "ReadPage", size=4, memory="eeprom"),
    request("Read Signature Bytes; seen", "75 20", "ReadSign"),
    request("Read Oscillator Calibration Byte", "76 20", "ReadOsccal"),
    request("Read Fuse Bits Extended", "77 20", "ReadFuseExt"),
    # Faulty requests.
    request("Unknown: directly followed by the end mark", "99 20", None, "unknown-id"),
    request("Nosync: another byte in place of the end mark", "30 21", "GetSync", "bad-sync"),
    request("Nosync: another byte in place of the end mark", "75 21", "ReadSign", "bad-sync"),
    request("Program Page: at most 256 bytes", "74 0101 46 20", "ReadPage", "bad-data"),
    request("Read Page: memory X", "74 0010 58 20", "ReadPage", "bad-data"),
    request("Get Synchronization: cut short", "30", "GetSync", "truncated"),
    request("Program Page: cut inside the data", "64 0004 46 01 02", "ProgPage", "truncated"),
    request("Set Device: one byte short", "42 8600 0001", "SetDevice", "truncated"),
)

REPLIES = (
    reply("Get Synchronization; seen", "30 20", "14 10", "OK"),
    reply("Check if Starterkit Present; seen", "31 20", "14 4156522053544B 10", "OK"),
    reply("Get Parameter Value; seen", "41 81 20", "14 08 10", "OK", value=8),
    reply("Get Parameter Value; seen", "41 82 20", "14 10 10", "OK", value=16),
    reply("Load Address; seen", "55 C0 00 20", "14 10", "OK"),
    reply("Universal Command; seen", "56 30 00 00 00 20", "14 1E 10", "OK", output=0x1E),
    reply("Read Flash Memory", "70 20", "14 34 12 10", "OK", word=0x1234),
    reply("Read Data Memory", "71 20", "14 5A 10", "OK", value=0x5A),
    reply("Read Fuse Bits", "72 20", "14 FF DE 10", "OK", low=0xFF, high=0xDE),
    reply("Read Lock Bits", "73 20", "14 CF 10", "OK", lock=0xCF),
    reply(
        "Read Page: its end is known by the request; seen",
        "74 0004 45 20",
        "14 A1 10 14 10 10",
        "OK",
        content=b"\xa1\x10\x14\x10",
    ),
    reply("Read Signature Bytes; seen", "75 20", "14 1E 95 0F 10", "OK", signature=b"\x1e\x95\x0f"),
    reply("Read Oscillator Calibration Byte; seen", "76 20", "14 00 10", "OK", value=0),
    reply(
        "Read Fuse Bits Extended", "77 20", "14 FF DE 05 10", "OK", low=255, high=0xDE, extended=5
    ),
    reply("Program Page", f"64 0080 46 {PAGE} 20", "14 10", "OK"),
    # Answers to what fails.
    reply("Enter Program Mode: no device was set", "50 20", "14 13", "NODEVICE"),
    reply("Check for Address Autoincrement: no", "53 20", "14 11", "FAILED"),
    reply("Get Parameter Value: no such parameter", "41 07 20", "14 07 11", "FAILED", value=7),
    reply("Nosync", "30 21", "15", "NOSYNC"),
    reply("Unknown", "99 20", "12", "UNKNOWN"),
)
