"""Frames of any layout: what the kit reads and builds is what construct alone reads and builds."""

from __future__ import annotations

from functools import cache
from random import Random
from typing import Any

import numpy as np
import pytest
from construct import Construct, ConstructError, Container
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from benchmarks.construct_alone import question
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.arrays.tables import request_tables
from bilprov.spec.codec import build, judge
from bilprov.spec.explain import explain
from bilprov.spec.fields import Outcome
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import build_reply, read_reply, reply_size
from tests.support.drawn_layouts import drawn_fields, drawn_layout, drawn_values
from tests.support.framed_traffic import READS_UNCHECKED, WITH_SYNC
from tests.support.grammars import CAMERA
from tests.vectors_modbus_rtu import REQUESTS

SEEDS = range(200)
drawn = cache(drawn_layout)


def flat(parsed: Any) -> dict[str, Any]:
    """The values within what construct parsed, by name."""
    found: dict[str, Any] = {}
    for name, value in parsed.items():
        if name.startswith("_") or name in ("offset1", "offset2"):
            continue
        if isinstance(value, Container) and "offset1" in value:
            found |= flat(value.value)
        elif isinstance(value, Container) and not _is_flags(value):
            found |= flat(value)
        else:
            found[name] = value
    return found


def _is_flags(value: Container) -> bool:
    return "a" in value and isinstance(value["a"], bool)


def plain(value: Any) -> Any:
    """A value of construct as the kit has it."""
    if isinstance(value, Container):
        return value.a + 8 * value.b
    if isinstance(value, list):
        return tuple(map(plain, value))
    if isinstance(value, str):
        return {"off": 0, "on": 1, "other": 9}.get(value, value)
    return value


def parsed(frame: Construct, raw: bytes, **context: Any) -> dict[str, Any]:
    return {name: plain(value) for name, value in flat(frame.parse(raw, **context)).items()}


def one_frame(draw: Random, protocol: Protocol) -> tuple[bytes, dict[str, Any], str]:
    """A valid frame of the protocol, its values and its instruction."""
    spec = draw.choice(protocol.instructions)
    values = drawn_values(draw, protocol, spec)
    return build(protocol, spec.name, values), values, spec.name


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_built_is_read_back_and_construct_agrees(seed: int) -> None:
    one, draw = drawn(seed), Random(seed)
    for _ in range(5):
        raw, values, name = one_frame(draw, one.protocol)
        judgement = judge(one.protocol, raw)
        assert (judgement.valid, judgement.name) == (True, name), (one.text, judgement.reason)
        read = {**one.protocol.layout.values(raw), **dict(judgement.fields)}
        assert {key: read[key] for key in values} == values
        alone = parsed(one.frame, raw)
        assert {key: alone[key] for key in values} == values, one.text


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_stream_of_frames_is_cut_into_them_however_it_comes(seed: int) -> None:
    one, draw = drawn(seed), Random(seed)
    frames = [one_frame(draw, one.protocol)[0] for _ in range(6)]
    stream, cutter, found = b"".join(frames), Framer(one.protocol, 50_000_000), []
    at = 0
    while at < len(stream):
        size = draw.randint(1, 7)
        found += cutter.feed(stream[at : at + size], at)
        at += size
    assert [record.data for record in found] == frames, one.text
    assert {record.kind for record in found} == {"instruction"}


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_frame_that_construct_refuses_is_faulty(seed: int) -> None:
    """Every bit of a frame is flipped once: what construct cannot read is never valid."""
    one, draw = drawn(seed), Random(seed)
    raw, _, _ = one_frame(draw, one.protocol)
    for bit in range(8 * len(raw)):
        changed = bytearray(raw)
        changed[bit // 8] ^= 1 << bit % 8
        cut = Framer(one.protocol, 1_000).feed(bytes(changed), 0)
        for record in cut:
            if record.kind != "instruction" or not judge(one.protocol, record.data).valid:
                continue
            try:
                one.frame.parse(record.data)
            except ConstructError as error:  # a value out of its range is construct's error too
                pytest.fail(f"{record.data.hex(' ')} is valid; construct: {error}\n{one.text}")


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", SEEDS)
def test_an_answer_is_read_back_and_construct_agrees(seed: int) -> None:
    one, draw = drawn(seed), Random(seed)
    protocol = one.protocol
    for _ in range(5):
        raw, _, name = one_frame(draw, protocol)
        asked = judge(protocol, raw)
        if not asked.answer_due:
            continue
        answer = protocol.by_name[name].answer
        assert answer is not None
        values = drawn_fields(draw, answer)
        reply = build_reply(protocol, asked, values)
        assert reply_size(protocol, reply + b"\0\0", asked) == len(reply), one.text
        assert all((reply_size(protocol, reply[:n], asked) or 999) > n for n in range(len(reply)))
        read = read_reply(protocol, reply, asked)
        assert (dict(read.fields), read.reason, read.names) == (values, "", ("OK",)), one.text
        alone = parsed(one.reply, reply, asked=question(one.frame, raw))
        assert {key: alone[key] for key in values} == values


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", SEEDS)
def test_an_error_is_read_back(seed: int) -> None:
    """Without a length nothing tells that an error lacks the data of the answer, so it has them."""
    protocol, draw = drawn(seed).protocol, Random(seed)
    asked = judge(protocol, one_frame(draw, protocol)[0])
    if asked.response.name != "OK":
        return
    error = build_reply(protocol, replace(asked, response=protocol.codes[21]))
    assert reply_size(protocol, error + b"\0\0", asked) == len(error), drawn(seed).text
    read = read_reply(protocol, error, asked)
    assert (read.names, read.reason) == (("NO",), ""), drawn(seed).text


def test_a_right_frame_within_a_damaged_one_is_found() -> None:
    one = next(d for d in map(drawn, SEEDS) if d.protocol.layout.check and d.protocol.layout.sync)
    draw = Random(1)
    first, second = (one_frame(draw, one.protocol)[0] for _ in range(2))
    damaged = first[:-1]  # its last byte was lost
    records = Framer(one.protocol, 1_000).feed(damaged + second + second, 0)
    assert [record.data for record in records if record.kind == "instruction"][-1] == second


def test_drawn_layouts_differ_in_all_that_a_layout_has() -> None:
    layouts = [drawn(seed).protocol.layout for seed in SEEDS]
    for role in ("address", "length", "other", "check", "constant"):
        assert 20 < sum(one.part(role) is not None for one in layouts) < 180, role
    assert 20 < sum(bool(one.unchecked) for one in layouts) < 180


def test_what_lacks_its_check_is_explained_and_answered() -> None:
    """The answer's bytes are typed by hand; the check counts neither the sync nor itself."""
    (cut,) = explain(load(READS_UNCHECKED), bytes.fromhex("80 18")).frames
    assert (cut.missing, cut.judgement.truncated) == (1, True)
    protocol = load(WITH_SYNC)
    asked = judge(protocol, bytes.fromhex("55 80 18 01"))
    reply = build_reply(protocol, asked, {"voltage": 124})
    assert (asked.valid, reply.hex(" ")) == (True, "00 7c 34 9f")


# -- parts of less than a byte ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "reason"), [("02", "mark is 0, right is 1"), ("8a", "a constant is 1, right is 0")]
)
def test_wrong_fixed_bits_are_said_and_begin_no_frame(first: str, reason: str) -> None:
    protocol = load(CAMERA)
    frame = bytes.fromhex(first + "09 04 47 ff")
    judgement = judge(protocol, frame)
    assert (judgement.outcome, judgement.reason) == (Outcome.BAD_SYNC, reason)
    assert [record.kind for record in Framer(protocol, 1_000).feed(frame, 0)] == []
    right = request_tables(protocol).cut(np.frombuffer(frame, np.uint8), 0)
    assert (len(right.whole.size), right.regular) == (0, False)


# -- sizes at which a check is right ---------------------------------------------------------------


@pytest.mark.parametrize("vector", [one for one in REQUESTS if one.outcome == "valid"], ids=str)
@given(more=st.binary(max_size=8))
def test_the_sizes_at_which_a_check_is_right(vector, more: bytes) -> None:  # type: ignore[no-untyped-def]
    check = load_protocol("modbus-rtu").layout.check
    assert check is not None
    data = vector.frame + more
    right = [n for n in range(4, len(data) + 1) if check.holds(data[:n])]

    assert list(check.right_sizes(data, 4)) == right
    assert len(vector.frame) in right
