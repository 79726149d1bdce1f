"""A saved state: decoding goes on from it as if it had never stopped; nonsense is refused."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from bilprov.analyzer.decode.checkpoint import DecoderState, WaitingFrames, decoded, encoded
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Resumption
from bilprov.spec.codec import build
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event
from tests.support.traffic import ACTS, SETTINGS, Acts, played, records_of, told

# Slow: more than make quick has time for.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, st.integers(0, 60), SETTINGS, st.booleans())
def test_a_session_that_is_resumed_gives_the_records_that_were_left(
    each_protocol: Protocol, acts: Acts, place: int, chosen: dict[str, Any], by_columns: bool
) -> None:
    events = played(each_protocol, acts)
    first: Session | StreamDecoder
    if by_columns:
        first = StreamDecoder(each_protocol, **chosen)
        first.feed(events[:place])
    else:
        first = Session(each_protocol, **chosen)
        for event in events[:place]:
            first.feed(event)
    state = first.saved()
    if state is None:  # it looks for frame boundaries
        return

    due, written = first.deadline, decoded(encoded(state), each_protocol)
    assert written == state
    left = told(first, events[place:])
    if by_columns:
        left = records_of(left)
    session, decoder = Session(each_protocol, **chosen), StreamDecoder(each_protocol, **chosen)
    session.resume(state)
    decoder.resume(state)

    assert session.saved() == decoder.saved() == state
    assert session.deadline == decoder.deadline == due
    assert told(session, events[place:]) == left
    assert records_of(told(decoder, events[place:], [7])) == left


def test_instructions_that_wait_are_saved_without_one_between_them_that_is_not_answered() -> None:
    protocol = load_protocol("modbus-rtu")
    frames = [
        build(protocol, "WriteSingleRegister", {"address": to, "register": 40, "value": 1})
        for to in (1, 2, 0, 3)  # 0: to all
    ]
    events: list[Event] = [Chunk(0, "host", frame) for frame in frames]
    decoder = StreamDecoder(protocol)
    decoder.feed(events)

    state = decoder.saved()
    assert state is not None
    assert [(group.first, group.frames) for group in state.waiting] == [
        (0, frames[0] + frames[1]),
        (3, frames[3]),
    ]
    decoder = StreamDecoder(protocol)
    decoder.resume(state)
    decoder.feed([Chunk(MS, "host", frames[0])])
    again = decoder.saved()
    assert again is not None
    assert [group.first for group in again.waiting] == [0, 3, 4]


def some_state(protocol: Protocol) -> DecoderState:
    """A state with a frame that is open, and instructions that wait."""
    spec = next(spec for spec in protocol.instructions if spec.length)
    frame = build(protocol, spec.name, {part.name: part.high for part in spec.fields})
    events: list[Event] = [Chunk(5 * MS, "host", frame * 2), Chunk(6 * MS, "host", frame[:-1])]
    session = Session(protocol)
    for event in events:
        session.feed(event)
    state = session.saved()
    assert state is not None
    assert state.waiting
    assert state.frame
    return state


@pytest.mark.parametrize("setting", [{"skew": 0}, {"timeout": 7 * MS}, {"heard": {"host"}}])
def test_a_state_of_a_session_with_other_settings_is_refused(
    protocol: Protocol, setting: dict[str, Any]
) -> None:
    state = some_state(protocol)

    with pytest.raises(ValueError, match="other settings"):
        Session(protocol, **setting).resume(state)
    with pytest.raises(ValueError, match="other settings"):
        StreamDecoder(protocol, **setting).resume(state)
    found = Checkpoint.of(9 * MS, protocol.sha256, encoded(state), resumes=True)
    (resumed,) = Session(protocol, **setting).feed(Resumption(9 * MS, "gap", checkpoint=found))
    (lost,) = Session(protocol, **setting).feed(Line(9 * MS, "gap"))
    assert resumed.state == lost.state


NONSENSE: dict[str, dict[str, Any]] = {
    "a motion that is none": {"motion": "sideways"},
    "standing still at full speed": {"motion": "forward", "speed": 255, "moving": False},
    "a speed that nothing sets": {"speed": 256},
    "a steering that fits into no column": {"steering": 1 << 80},
    "a frame that is complete": {"frame": b"\x11\x05"},
    "a frame that ends before it begins": {"frame_start": 6 * MS, "frame_end": 5 * MS},
    "bytes from the future": {"frame_end": 1 << 70},
    "answers from the future": {"waiting": (), "held": ((1 << 70, 0),)},
    "answers from before the beginning": {"waiting": (), "held": ((-1, 0),)},
    "a loss in the future": {"lost_at": 1 << 70},
    "silence since the future": {"unsynced_since": 1 << 70},
    "an answer that is no byte": {"waiting": (), "held": ((0, 256),)},
    "an answer that waits beside an instruction": {"held": ((0, 0),)},
    "more that waits than ever came": {"sequence": 1},
    "more instructions than there can be": {"sequence": 1 << 63},
    "nothing waits": {"waiting": (WaitingFrames(0, 1000 * MS, b""),)},
    "what waits is given up out of order": {
        "waiting": (WaitingFrames(1, 2, b"\0"), WaitingFrames(1, 1, b"\0"))
    },
    "waiting, though the device is not heard": {"heard": ("host",)},
    "the same direction twice": {"heard": ("host", "host")},
    "no frame to be out of step with": {"frame": b"", "out_of_step": 9},
}


@pytest.mark.parametrize("kind", NONSENSE)
def test_a_state_that_no_session_can_be_in_is_refused(protocol: Protocol, kind: str) -> None:
    good = some_state(protocol)
    change = dict(NONSENSE[kind])
    car = {key: change.pop(key) for key in list(change) if hasattr(good.state, key)}
    bad = replace(good, state=replace(good.state, **car), **change)

    assert decoded(encoded(good), protocol) == good
    assert decoded(encoded(bad), protocol) is None
    with pytest.raises(ValueError, match="no session"):
        bad.require_sense(protocol)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["end", "expires", "frames", "motion", "t"]), inner)
    ),
    max_leaves=6,
)
NUMBERS = st.sampled_from([-1, 0, 1, 2, 255, 256, MS, 5 * MS, 1 << 62, 1 << 63, 1 << 80])


@settings(max_examples=100)
@given(data=st.data())
def test_no_text_whatever_breaks_the_decoding(protocol: Protocol, data: st.DataObject) -> None:
    whole = msgspec.json.decode(encoded(some_state(protocol)))
    keys = data.draw(st.lists(st.sampled_from(sorted(whole)), max_size=3))
    for key in keys:
        whole[key] = data.draw(NUMBERS | VALUES)
    if data.draw(st.booleans()):
        whole["state"] = dict(whole["state"]) if isinstance(whole["state"], dict) else {}
        whole["state"][data.draw(st.sampled_from(["speed", "led", "moving", "motion"]))] = (
            data.draw(NUMBERS | VALUES)
        )
    text = msgspec.json.encode(whole).decode()
    cut = data.draw(st.sampled_from([None, None, None, len(text) // 2, 1, 0]))

    state = decoded(text[:cut], protocol)

    if state is not None:
        chosen: dict[str, Any] = {"timeout": state.timeout, "skew": state.skew}
        chosen["heard"] = frozenset(state.heard)
        session, decoder = Session(protocol, **chosen), StreamDecoder(protocol, **chosen)
        if tuple(sorted(set(state.heard))) != state.heard:
            return
        session.resume(state)
        decoder.resume(state)
        events = played(protocol, data.draw(ACTS))
        assert records_of(told(decoder, events, [9])) == told(session, events)


@pytest.mark.parametrize("text", ["", "{}", "[" * 100_000, '"\ud800"', "null", "\0", "1e999"])
def test_what_is_no_state_at_all_is_refused(protocol: Protocol, text: str) -> None:
    assert decoded(text, protocol) is None


def test_a_time_that_no_clock_shows_is_refused(protocol: Protocol) -> None:
    assert decoded(encoded(replace(some_state(protocol), time=(1 << 61) + 1)), protocol) is None
