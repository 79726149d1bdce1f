"""Tables and steps: verdicts and states of all frames at once, or one by one."""

from __future__ import annotations

from bisect import bisect_right
from functools import partial
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.spec.arrays.layouts import OUTCOMES, WIDEST, Checking, field_values, number_values
from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import RequestTables, answer_tables, request_tables
from bilprov.spec.checks import CheckFunction, Crc, Fletcher, Sum, Xor
from bilprov.spec.codec import Steps, build, judge, nearest, raw_frame
from bilprov.spec.data import Number
from bilprov.spec.framing import Framer
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.state import State, after
from tests.support.car import VARIABLES, car_state
from tests.support.framed_traffic import FRAMED
from tests.support.grammars import undeclared

MOTIONS = tuple(Motion)
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


def every_first_byte(protocol: Protocol, random: Random) -> list[bytes]:
    """A frame of each header with each first data byte, the other data random, in random order."""
    frames = [
        (bytes([header, first]) + random.randbytes(length))[: 1 + length]
        for header, length in enumerate(protocol.lengths)
        for first in range(256)
    ]
    # Random data of a wide field are seldom valid.
    frames += [nearest(protocol, frame) for frame in random.sample(frames, 5000)]
    random.shuffle(frames)
    return frames


@pytest.mark.sample(1)
@pytest.mark.slow
def test_every_header_and_first_byte_has_the_verdict_and_the_state_of_the_grammar(
    each_protocol: Protocol,
) -> None:
    frames = every_first_byte(each_protocol, Random(1))
    data = np.frombuffer(b"".join(frames), np.uint8)
    tables = request_tables(each_protocol)
    before = each_protocol.state(motion=MOTIONS[2], speed=9, steering=-8, led=7)

    requests, end, _ = tables.cut(data, 0)
    known = Known(before, None)
    states = [tables.states.column(name, data, requests, known) for name in VARIABLES]

    starts = np.cumsum([0, *(len(frame) for frame in frames)])
    assert (requests.offset.tolist(), end) == (starts[:-1].tolist(), starts[-1])
    state, expected = before, []
    for frame in frames:
        judgement = judge(each_protocol, frame)
        effect = each_protocol.on_fault
        if judgement.valid and judgement.instruction:
            effect = judgement.instruction.effect
        state = effect.apply(state, dict(judgement.fields))
        expected.append((judgement.outcome, MOTIONS.index(state.motion), *_numbers(state)))
    verdicts = [OUTCOMES[code] for code in requests.verdict.tolist()]
    assert list(zip(verdicts, *(column[1:].tolist() for column in states), strict=True)) == expected


def _numbers(state: State) -> tuple[int, int, int]:
    return state.speed, state.steering, state.led


@given(data=st.binary(max_size=200), padding=st.sampled_from([0, 5000]))
def test_the_last_state_is_the_last_of_all_states(
    each_protocol: Protocol, data: bytes, padding: int
) -> None:
    stream = data
    if padding:  # what was set long before is kept
        for spec in each_protocol.instructions:
            highest = {part.name: part.high for part in spec.fields}
            stream = build(each_protocol, spec.name, highest) + stream
        stream += bytes([each_protocol.pad_byte]) * padding
    tables = request_tables(each_protocol)
    array = np.frombuffer(stream, np.uint8)
    requests = tables.cut(array, 0).whole
    before = each_protocol.state(motion="forward", speed=5, steering=-6, led=1)

    known = Known(before, None)
    states = [tables.states.column(name, array, requests, known) for name in VARIABLES]

    last = [int(column[-1]) for column in states]
    found = tables.states.last(array, requests, known)
    assert (found.state.codes, found.by_address) == (tuple(last), None)


@given(data=st.data())
def test_every_field_of_every_frame_has_the_value_that_the_grammar_parses(
    each_protocol: Protocol, data: st.DataObject
) -> None:
    tables = request_tables(each_protocol)
    for spec in each_protocol.instructions:
        if not spec.fields:
            continue
        header = each_protocol.header_bytes[spec.id, spec.length]
        frames = data.draw(
            st.lists(st.binary(min_size=spec.length, max_size=spec.length), min_size=1, max_size=5)
        )
        array = np.frombuffer(b"".join(bytes([header]) + frame for frame in frames), np.uint8)
        offsets, _ = tables.offsets(array)
        for part in spec.fields:
            values = field_values(part, array, offsets + 1).tolist()
            assert values == [spec.decode(frame)[part.name] for frame in frames]


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


@pytest.mark.parametrize(
    "edit",
    [
        ('led=From("rgb")', f'led=From("rgb", factor={1 << 70})'),
        ("speed=0, steering=0, led=0)", f"speed=0, steering=0, led={1 << 70})"),
        ("FAULTY = Sets(", f"FAULTY = Sets(led={1 << 70}, "),
        ('"speed" / Ranged(Byte, 0, 255)', '"speed" / Ranged(BytesInteger(8), 0, 255)'),
    ],
)
def test_a_grammar_whose_numbers_do_not_fit_into_64_bits_is_refused(
    grammar_text: str, edit: tuple[str, str]
) -> None:
    text = undeclared(grammar_text)
    assert text.count(edit[0]) == 1
    text = text.replace(*edit).replace("Byte, Struct", "Byte, BytesInteger, Struct")

    with pytest.raises(OverflowError):
        RequestTables(load(text))


def test_an_answer_whose_size_only_its_request_tells_is_refused() -> None:
    with pytest.raises(OverflowError):
        answer_tables(load(FRAMED["stk500v1"]))


@pytest.mark.parametrize("led", [-1, 1 << 15, -(1 << 31), (1 << 62)])
def test_a_state_that_only_power_on_sets_fits(grammar_text: str, led: int) -> None:
    text = undeclared(grammar_text)
    other = load(text.replace("steering=0, led=0)", f"steering=0, led={led})"))
    tables = RequestTables(other)
    stop = np.array([other.pad_byte], np.uint8)

    requests = tables.cut(stop, 0).whole
    state = tables.states.column("led", stop, requests, Known(other.power_on, None))

    assert state.tolist() == [led, led]


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


NUMBERS = st.builds(
    Number, st.integers(1, WIDEST), st.sampled_from(["big", "little"]), signed=st.booleans()
)
_crc = st.sampled_from([1, 3, 5, 7, 8, 12, 16, 24, 32]).flatmap(
    lambda width: st.builds(
        partial(Crc, width),
        st.integers(0, (1 << width) - 1),
        st.integers(0, (1 << width) - 1),
        reflected=st.booleans(),
        xorout=st.integers(0, (1 << width) - 1),
        refout=st.booleans(),
    )
)
CHECKS = st.one_of(
    st.builds(Sum, st.sampled_from([8, 16, 24, 32]), st.booleans()),
    st.builds(Fletcher, st.sampled_from([255, 256])),
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
