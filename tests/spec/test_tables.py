"""Tables and steps: verdicts and states of all frames at once, or one by one."""

from __future__ import annotations

from bisect import bisect_right
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import RequestTables, request_tables
from bilprov.spec.codec import Steps, build, judge, raw_frame
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.state import OTHERS, State, after
from tests.support.car import car_state
from tests.support.framed_traffic import FRAMED
from tests.support.grammars import undeclared

BLOCK = 1 << 16  # how many bytes are tokenized at once: lengths around it are tried


def framed(protocol: Protocol, data: bytes) -> tuple[list[int], int]:
    """The places of the whole frames, and of the first header after them, by Framer."""
    framer = Framer(protocol, None)
    sizes = [len(frame.data) for frame in framer.feed(data, 0)]
    places = [0]
    for size in sizes:
        places.append(places[-1] + size)
    return places[:-1], places[-1]


def found(tables: RequestTables, data: bytes, start: int = 0) -> tuple[list[int], int]:
    offsets, end = tables.offsets(np.frombuffer(data, np.uint8), start)
    return offsets.tolist(), end


@given(stream=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=8))
def test_a_stream_in_any_cuts_has_the_same_frames(
    each_protocol: Protocol, stream: bytes, cuts: list[int]
) -> None:
    tables = request_tables(each_protocol)

    pieces, header = [], 0
    for cut in [*sorted(min(cut, len(stream)) for cut in cuts), len(stream)]:
        offsets, header = found(tables, stream[:cut], header)
        pieces += offsets

    assert (pieces, header) == framed(each_protocol, stream)


@pytest.mark.sample(4)
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["random", "one header", "the longest", "none has data"])
def test_streams_around_the_size_of_a_block_have_the_frames_of_the_framer(
    each_protocol: Protocol, kind: str
) -> None:
    tables = request_tables(each_protocol)
    longest = each_protocol.lengths.index(each_protocol.longest_frame - 1)
    one = next(h for h, length in enumerate(each_protocol.lengths) if length == 1)
    stream = {
        "random": Random(5).randbytes(2 * BLOCK + 100),
        # Framings that begin at different bytes never come together.
        "one header": bytes([one]) * (2 * BLOCK + 100),
        "the longest": bytes([longest]) * (2 * BLOCK + 100),
        "none has data": bytes([each_protocol.pad_byte]) * (2 * BLOCK + 100),
    }[kind]

    sizes = [1 + length for length in each_protocol.lengths]
    for start in (0, 1):
        places, _ = framed(each_protocol, stream[start:])
        ends = [place + sizes[stream[start + place]] for place in places]
        for length in (BLOCK, 2 * BLOCK):
            for more in (-each_protocol.longest_frame, -2, -1, 0, 1, 2, 33):
                offsets, end = found(tables, stream[: length + more], start)
                whole = bisect_right(ends, length + more - start)
                assert offsets == [start + place for place in places[:whole]]
                assert end == start + ends[whole - 1]


@pytest.mark.parametrize("led", [-1, 1 << 15, -(1 << 31), (1 << 62)])
def test_a_state_that_only_power_on_sets_fits(grammar_text: str, led: int) -> None:
    text = undeclared(grammar_text)
    other = load(text.replace("steering=0, led=0)", f"steering=0, led={led})"))
    tables = RequestTables(other)
    stop = np.array([other.pad_byte], np.uint8)

    requests = tables.cut(stop, 0).whole
    state = tables.states.column("led", stop, requests, Known(other.power_on, None))

    assert state.tolist() == [led, led]


def test_the_last_state_of_a_device_is_that_after_the_last_request_to_it() -> None:
    claw = load(FRAMED["roboclaw"])
    sent = [("ForwardM1", 0x80, 5), ("ForwardM1", 0x81, 7), ("ForwardM1", 0x80, 9)]
    frames = [build(claw, name, {"address": to, "speed": speed}) for name, to, speed in sent]
    data, tables = np.frombuffer(b"".join(frames), np.uint8), request_tables(claw)
    known = Known(claw.power_on, {OTHERS: claw.power_on, 0x82: claw.state(m1=3)})

    found = tables.states.last(data, tables.cut(data, 0).whole, known)

    assert found.state.m1 == 9
    assert found.by_address is not None
    speeds = {to: state.m1 for to, state in found.by_address.items()}
    assert speeds == {OTHERS: 0, 0x80: 9, 0x81: 7, 0x82: 3}


BEFORE = car_state(speed=11, steering=-7, led=3)


def judged(protocol: Protocol, frame: bytes, state: State = BEFORE) -> State:
    """The state after a frame by the grammar's own effects."""
    judgement = judge(protocol, frame)
    effect = judgement.instruction.effect if judgement.valid and judgement.instruction else None
    return (effect or protocol.on_fault).apply(state, dict(judgement.fields))


def test_every_header_at_every_truncation_is_judged_as_by_the_grammar(
    each_protocol: Protocol,
) -> None:
    random, steps = Random(1), Steps(each_protocol)

    for header, length in enumerate(each_protocol.lengths):
        for arrived in range(length + 1):
            for _ in range(2):
                frame = bytes([header]) + random.randbytes(arrived)
                step = steps[frame]
                assert step.judgement == judge(each_protocol, frame)
                assert after(BEFORE, step.sets) == judged(each_protocol, frame)
                assert steps[frame] == step


@pytest.mark.slow
def test_no_more_frames_than_64_ki_are_remembered_and_all_are_judged_right(wide: Protocol) -> None:
    steps = Steps(wide)
    spec = next(spec for spec in wide.instructions if spec.length > 2)
    frames = [
        raw_frame(wide, spec.id, spec.length, n.to_bytes(spec.length, "big")) for n in range(70_000)
    ]

    for frame in frames:
        steps[frame]  # asking is what makes it remember

    assert len(steps) <= 1 << 16
    assert steps[frames[-1]].judgement == judge(wide, frames[-1])
