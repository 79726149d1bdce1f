"""Codec: frames are judged and built as the document says, and the nearest valid one is found."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from construct import ValidationError
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec import checks
from bilprov.spec.checks import CheckFunction, Crc, Fletcher, Sum
from bilprov.spec.codec import all_data, bad_data, build, judge, nearest, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.grammar import FRAME
from bilprov.spec.protocol import Protocol, load
from tests.vectors import FRAME_COUNTS, HEADERS, InstructionRow
from tests.vectors_checks import CHECKS, DIGITS, CheckVector

DATA_BYTES = {row.id: row.length for row in HEADERS}


def _judged_by_hand(frame: bytes) -> tuple[int, str]:
    """Response code and class of a frame, in the order header, length, data."""
    identity, length = frame[0] >> 4, frame[0] & 0b1111
    arrived = len(frame) - 1
    cut = arrived < length
    if identity not in DATA_BYTES:
        return 1, "truncated" if cut else "unused"
    if cut:
        return 4, "truncated"
    if length > DATA_BYTES[identity]:
        return 3, "wrong length"
    if length < DATA_BYTES[identity]:
        return 4, "wrong length"
    if identity == 8 and frame[1] & 0b11111000:
        return 2, "bad data"
    return 0, "valid"


def test_every_single_frame_there_is_is_judged_as_by_hand(protocol: Protocol) -> None:
    counts: Counter[str] = Counter()
    for header in range(256):
        length = header & 0b1111
        known = DATA_BYTES.get(header >> 4) == length == 1
        whole = [bytes([b]) for b in range(256)] if known else [bytes(length)]
        for data in (*whole, *(bytes(arrived) for arrived in range(length))):
            code, kind = _judged_by_hand(bytes([header]) + data)
            counts[kind] += 1
            assert judge(protocol, bytes([header]) + data).response.code == code

    assert counts == FRAME_COUNTS


@given(st.binary(min_size=1, max_size=16))
def test_any_data_are_judged_as_by_hand(protocol: Protocol, data: bytes) -> None:
    frame = data[: 1 + (data[0] & 0b1111)]
    judgement, (code, kind) = judge(protocol, frame), _judged_by_hand(frame)

    assert judgement.response.code == code
    assert (judgement.id, judgement.length) == (frame[0] >> 4, frame[0] & 0b1111)
    assert judgement.valid == (kind == "valid") == (not judgement.reason)
    assert judgement.truncated == (kind == "truncated")
    assert judgement.clause.startswith("section ")


def test_construct_itself_agrees_on_every_frame_of_right_length(protocol: Protocol) -> None:
    for row in HEADERS:
        header = {"id": row.id, "length": row.length}
        for data in [bytes([b]) for b in range(256)] if row.length else [b""]:
            frame = bytes([row.id << 4 | row.length]) + data
            judgement = judge(protocol, frame)
            parts = {"header": header, "data": dict(judgement.fields)}
            if judgement.valid:
                parsed = FRAME.parse(frame)
                assert parsed.header.items() >= header.items()
                assert parsed.data.items() >= dict(judgement.fields).items()
                assert FRAME.build(parts) == frame
            else:
                assert judgement.outcome is Outcome.BAD_DATA
                for refuse, value in ((FRAME.parse, frame), (FRAME.build, parts)):
                    with pytest.raises(ValidationError):
                        refuse(value)


@pytest.mark.parametrize("frame", [b"", b"\x20\xff"])
def test_what_is_not_one_frame_cannot_be_judged(protocol: Protocol, frame: bytes) -> None:
    with pytest.raises(ValueError, match="frame"):
        judge(protocol, frame)


@pytest.mark.parametrize("row", HEADERS, ids=lambda r: r.name)
def test_what_is_built_is_judged_valid_and_gives_its_fields_back(
    protocol: Protocol, row: InstructionRow
) -> None:
    spec = protocol.by_id[row.id]
    good, bad = list(all_data(spec)), list(bad_data(spec))
    assert sorted(good + bad) == ([bytes([value]) for value in range(256)] if row.length else [b""])
    assert len(bad) == (248 if row.name == "LED" else 0)
    for data in good:
        judgement = judge(protocol, raw_frame(protocol, spec.id, spec.length, data))

        assert judgement.valid
        for name in (spec.name, spec.name.lower(), spec.name.upper()):
            assert build(protocol, name, dict(judgement.fields)) == judgement.frame


def test_a_header_may_lie_about_its_data_but_carries_no_more_than_its_bits(
    protocol: Protocol,
) -> None:
    assert raw_frame(protocol, 4, 0, b"\xff") == bytes([0b01000000, 0b11111111])
    assert raw_frame(protocol, 15, 15) == b"\xff"
    for identity, length in ((16, 0), (0, 16), (-1, 0), (0, -1)):
        with pytest.raises(ValueError, match=f"^no header carries ID {identity} with length"):
            raw_frame(protocol, identity, length)


def test_the_nearest_value_of_named_bits_is_in_their_range(grammar_text: str) -> None:
    lit = load(grammar_text.replace("Ranged(Byte, 0, 7,", "Ranged(Byte, 1, 7,"))

    assert nearest(lit, b"\x81\x08") == b"\x81\x01"


@given(data=st.binary(min_size=1, max_size=16), following=st.binary(max_size=3))
def test_the_nearest_frame_is_valid_and_is_nearest_to_itself(
    protocol: Protocol, data: bytes, following: bytes
) -> None:
    frame = data[: 1 + (data[0] & 0b1111)]
    found = nearest(protocol, frame, following)

    assert judge(protocol, found).valid
    assert nearest(protocol, found, following) == found
    if judge(protocol, frame).valid:
        assert found == frame


# -- sums, exclusive ors and CRCs: the published values, and those of each prefix ------------------

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
