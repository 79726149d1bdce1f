"""Whatever a capture file holds, an opened capture gives texts that print and numbers in range."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.writer import Writer

from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.text import PRINTABLE_CHARACTERS
from bilprov.captures.topics import CHANNEL_START_KEY, LINE, LOOKS, METADATA_NAME
from bilprov.captures.wall_clock import LONGEST

BAD = "\x1b[31m \u202e \ud800 \r\n [/x] \0 \u200b é"
TEXTS = st.text(st.sampled_from(BAD), max_size=8) | st.sampled_from(["x" * 300, "\x9b" * 100])
NUMBERS = st.integers(-(1 << 70), 1 << 70)
LATEST = (1 << 64) - 1
TIMES = st.integers(0, LATEST)
MESSAGES = st.tuples(
    TIMES,
    st.fixed_dictionaries({"t": NUMBERS, "event": TEXTS, "detail": TEXTS})
    | st.fixed_dictionaries({"t": NUMBERS, "moving": st.none(), "motion": TEXTS, "left": NUMBERS})
    | st.binary(max_size=4),
)


def numbers_and_texts(value: object) -> Iterator[object]:
    """Yield the numbers and texts in a value made of values."""
    if isinstance(value, str | int):
        yield value
    elif isinstance(value, dict):
        for pair in value.items():
            yield from numbers_and_texts(pair)
    elif isinstance(value, msgspec.Struct):
        yield from numbers_and_texts(msgspec.structs.asdict(value))
    elif isinstance(value, tuple | list):
        for one in value:
            yield from numbers_and_texts(one)


def safe(held: object) -> bool:
    if isinstance(held, str):
        return held.isprintable() and len(held) <= PRINTABLE_CHARACTERS
    return not isinstance(held, int) or -LONGEST <= held <= LONGEST


def given_by(capture: Capture) -> Iterator[object]:
    contents = capture.contents
    yield contents.library, capture.metadata, capture.damage
    yield contents.channels, contents.counts, contents.sizes
    yield contents.first - capture.start, contents.last - capture.start, capture.left_out
    yield from capture.sights()
    yield from (event for batch in capture.batches() for event in batch.single())
    yield from ((message.topic, message.t) for message in capture.messages())
    yield from capture.losses()


FAR_LOOK = {"t": 0, "moving": None, "motion": "", "left": 1 << 70}


@example(library="", pairs={}, topic="x", start="0", messages=[(LATEST, b"")])
@example(library="", pairs={}, topic="x", start="0", messages=[(0, FAR_LOOK)])
@given(
    library=TEXTS,
    pairs=st.dictionaries(TEXTS, TEXTS, max_size=2),
    topic=TEXTS,
    start=st.integers(0, 1 << 68).map(str) | TEXTS,
    messages=st.lists(MESSAGES, max_size=5),
)
def test_all_that_an_opened_capture_gives_is_bounded_prints_and_is_in_range(
    tmp_path_factory: pytest.TempPathFactory,
    library: str,
    pairs: dict[str, str],
    topic: str,
    start: str,
    messages: list[tuple[int, Any]],
) -> None:
    path = tmp_path_factory.mktemp("hostile") / "a.mcap"

    def text(drawn: str) -> str:
        return drawn.encode("utf-8", "replace").decode()

    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start("", text(library))
        writer.add_metadata(METADATA_NAME, {text(key): text(pairs[key]) for key in pairs})
        raw = writer.register_channel("/host/raw", "", 0, {CHANNEL_START_KEY: text(start)})
        writer.register_channel(text(topic), text(topic), 0)
        line, looks = (writer.register_channel(name, "json", 0) for name in (LINE, LOOKS))
        for time, value in messages:
            if isinstance(value, bytes):
                writer.add_message(raw, time, value, time)
            else:
                channel = line if "event" in value else looks
                data = msgspec.json.encode(
                    {k: text(v) if isinstance(v, str) else v for k, v in value.items()}
                )
                writer.add_message(channel, time, data, time)
        writer.finish()
    capture = open_capture(path)
    assert 0 <= capture.start < 1 << 64
    found = [held for value in given_by(capture) for held in numbers_and_texts(value)]
    assert [held for held in found if not safe(held)] == []
    times = [time - capture.start for time, value in messages if isinstance(value, bytes)]
    kept = [value.t for value in capture.recorded() if isinstance(value, Chunk)]
    assert kept == [min(max(time, -LONGEST), LONGEST) for time in times]
