"""Checks of every prefix of some bytes, each byte counted once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.checks import CheckFunction, Crc, Sum, Xor
from tests.vectors_modbus_rtu import REQUESTS

FUNCTIONS = [
    Sum(8),
    Sum(16, complement=True),
    Sum(8, complement=2),
    Sum(16, complement=2),
    Xor(0x5A),
    Crc(8, 0xD5),
    Crc(16, 0x1021, 0xFFFF),
    Crc(16, 0x8005, 0xFFFF, reflected=True),
    Crc(32, 0x04C11DB7, 0xFFFFFFFF, reflected=True, xorout=0xFFFFFFFF),
]


@pytest.mark.parametrize("function", FUNCTIONS, ids=repr)
@given(data=st.binary(max_size=20))
def test_the_running_check_is_that_of_each_prefix(function: CheckFunction, data: bytes) -> None:
    assert list(function.running(data)) == [function(data[:n]) for n in range(len(data) + 1)]


@pytest.mark.parametrize("vector", [one for one in REQUESTS if one.outcome == "valid"], ids=str)
@given(more=st.binary(max_size=8))
def test_the_sizes_at_which_a_check_is_right(vector, more: bytes) -> None:  # type: ignore[no-untyped-def]
    check = load_protocol("modbus-rtu").layout.check
    assert check is not None
    data = vector.frame + more
    right = [n for n in range(4, len(data) + 1) if check.holds(data[:n])]

    assert list(check.right_sizes(data, 4)) == right
    assert len(vector.frame) in right
