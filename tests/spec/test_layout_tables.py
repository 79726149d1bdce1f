"""Frames of any layout as columns: they say what the judgement of single frames says."""

from __future__ import annotations

from functools import partial

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec.arrays.checks import Checking
from bilprov.spec.arrays.layouts import WIDEST, number_values
from bilprov.spec.checks import CheckFunction, Crc, Sum, Xor
from bilprov.spec.numbers import Number

NUMBERS = st.builds(
    Number, st.integers(1, WIDEST), st.sampled_from(["big", "little"]), signed=st.booleans()
)
_crc = st.sampled_from([8, 16, 24, 32]).flatmap(
    lambda width: st.builds(
        partial(Crc, width),
        st.integers(0, (1 << width) - 1),
        st.integers(0, (1 << width) - 1),
        reflected=st.booleans(),
        xorout=st.integers(0, (1 << width) - 1),
    )
)
CHECKS = st.one_of(
    st.builds(Sum, st.sampled_from([8, 16, 24, 32]), st.booleans()),
    st.builds(Xor, st.integers(0, 255)),
    _crc,
)


@given(NUMBERS, st.lists(st.binary(min_size=WIDEST, max_size=WIDEST), max_size=5))
def test_numbers_out_of_an_array_are_those_of_single_bytes(
    number: Number, parts: list[bytes]
) -> None:
    data = np.frombuffer(b"".join(parts), np.uint8)
    at = np.arange(len(parts)) * WIDEST

    values = number_values(number, data, at).tolist()

    assert values == [number.parse(part[: number.size]) for part in parts]


@given(CHECKS, st.lists(st.tuples(st.binary(max_size=9), st.binary(max_size=40)), max_size=6))
def test_checks_of_many_stretches_are_those_of_each_by_itself(
    function: CheckFunction, pieces: list[tuple[bytes, bytes]]
) -> None:
    checking = Checking(function, len(pieces))
    for place in range(2):
        parts = [piece[place] for piece in pieces]
        size = np.array(list(map(len, parts)), np.int64)
        start = np.cumsum(size) - size
        checking.take(np.frombuffer(b"".join(parts), np.uint8), start, start + size)

    assert checking.values.tolist() == [function(b"".join(piece)) for piece in pieces]
