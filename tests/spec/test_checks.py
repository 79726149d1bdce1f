"""Sums, exclusive ors and CRCs: the published values, and those of each prefix."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec import checks
from bilprov.spec.checks import CheckFunction, Crc, Fletcher, Sum
from tests.vectors_checks import CHECKS, DIGITS, CheckVector

FUNCTIONS = [eval(one.declared, vars(checks)) for one in CHECKS]
CASES = list(zip(CHECKS, FUNCTIONS, strict=True))


def test_the_check_of_nine_digits_is_the_published_one() -> None:
    found = [CheckVector(one.name, one.declared, function(DIGITS)) for one, function in CASES]
    assert found == CHECKS


@pytest.mark.parametrize(
    ("check", "covered", "value"),
    [
        (Crc(7, 0x09, reflected=True), "83 01", "17"),  # Pololu's guide
        (Fletcher(), "06 08 06 00 c8 00 01 00 01 00", "de 6a"),  # UBX-CFG-RATE, 5 Hz
        (Fletcher(), "0a 04 00 00", "0e 34"),  # UBX-MON-VER
        (Sum(8, complement=2), "01 86 00 00 00 00 00", "79"),  # MH-Z19B, read
        (Sum(8, complement=True), "01 02 01", "fb"),  # a ping of DYNAMIXEL 1.0
    ],
)
def test_the_check_of_a_frame_is_that_of_its_datasheet(
    check: Any, covered: str, value: str
) -> None:
    raw = bytes.fromhex(value)
    assert check(bytes.fromhex(covered)) == int.from_bytes(raw, "little")


@given(function=st.sampled_from(FUNCTIONS), data=st.binary(max_size=20))
def test_the_running_check_is_that_of_each_prefix(function: CheckFunction, data: bytes) -> None:
    assert list(function.running(data)) == [function(data[:n]) for n in range(len(data) + 1)]
