"""What bytes nearly are that do not decode, and why: checksum, length, range, sync, ID."""

from __future__ import annotations

import pytest

from bilprov.analyzer.decode.decoded_share import Checked, declared, fitting_check, near_miss
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.checks import Crc, Sum


@pytest.mark.parametrize(
    ("grammar", "sent", "name", "obstacle", "reason"),
    [
        (
            "modbus-rtu",
            "11 03 006B 0003 8776",
            "ReadHoldingRegisters",
            "checksum",
            "right is 76 87",
        ),
        ("modbus-rtu", "11 05 0028 0001 8E92", "WriteSingleCoil", "range", "value is 1"),
        ("modbus-rtu", "11 06 0001 0003 0000 2B0B", "WriteSingleRegister", "length", "takes 4"),
        ("modbus-rtu", "11 03 006B", "ReadHoldingRegisters", "length", "4 bytes of 8 bytes came"),
        ("modbus-rtu", "11 41 CDD0", "", "id", "no instruction has ID 65"),
        ("dynamixel1", "FFFE 01 02 01 FB", "Ping", "sync", "begins with ff fe, right is ff ff"),
        ("dynamixel1", "FF 01 02 01 FB", "Ping", "sync", "begins with ff, right is ff ff"),
        ("dynamixel1", "01 02 01 FB", "Ping", "sync", "no such bytes"),
        ("dynamixel1", "FFFF 01 02 01 FA", "Ping", "checksum", "sum is fa, right is fb"),
        ("dynamixel1", "FFFF 01 03 01 00 FA", "Ping", "length", "takes 0 data bytes, 1 came"),
        ("stk500v1", "30 21", "GetSync", "sync", "21 stands where 20 must be"),
        ("stk500v1", "74 0010 58 20", "ReadPage", "range", "memory is 88"),
        ("robot-car", "81 09", "LED", "range", "rgb is 9"),
        ("robot-car", "90", "", "id", "no instruction has ID 9"),
    ],
)
def test_the_nearest_instruction_is_told_with_what_is_wrong(
    grammar: str, sent: str, name: str, obstacle: str, reason: str
) -> None:
    found = near_miss(load_protocol(grammar), bytes.fromhex(sent))

    assert found is not None
    assert (found.name, found.obstacle) == (name, obstacle)
    assert reason in found.reason


def test_a_valid_frame_is_no_near_miss() -> None:
    assert near_miss(load_protocol("dynamixel1"), bytes.fromhex("FFFF 01 02 01 FB")) is None
    assert near_miss(load_protocol("dynamixel1"), bytes.fromhex("123456789ABC")) is None


def test_one_frame_says_little_of_a_check_of_one_byte() -> None:
    layout = load_protocol("dynamixel1").layout
    frames = [Checked(bytes.fromhex(f"FFFF 0{to} 02 01 0{to + 3}")) for to in (1, 2)]
    negative = [Checked(frame[:-1] + bytes([-sum(frame[2:-1]) & 0xFF])) for frame, _ in frames]

    assert fitting_check(layout, frames[:1]) == ""
    assert fitting_check(layout, frames) == '"sum" / Checksum(Byte, Sum(8), this.covered.data)'
    assert "Checksum(Byte, Sum(8, complement=2), this" in fitting_check(layout, negative)


def test_a_check_is_told_as_it_is_declared() -> None:
    crc = Crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF)

    assert eval(declared(crc), {"Crc": Crc}) == crc
    for complement in (0, 1, 2):
        total = Sum(8, complement=complement)
        assert eval(declared(total), {"Sum": Sum}) == total
