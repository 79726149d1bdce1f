"""A session in parts: no byte and no frame is lost or doubled at a seam, whatever passes there."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.output.outputs import Output, Shown
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_decoding import opened_at
from bilprov.analyzer.replay.recorder import Recorder, Rotation, rotation_at, session_metadata
from bilprov.captures import topics
from bilprov.captures.parts import part_paths
from bilprov.captures.reader import Capture, open_capture, open_quickly
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support.attaching import Talk, attached
from tests.support.captures import about
from tests.support.decoding import Event
from tests.support.messages import messages
from tests.support.robots import until
from tests.support.traffic import ACTS, SETTINGS, played, records_of

START = 1_790_000_000_000_000_000
SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "rotation"),
    [
        ("100kB", Rotation(size=100_000)),
        ("100MB", Rotation(size=100_000_000)),
        ("1.5 GB", Rotation(size=1_500_000_000)),
        ("128kib", Rotation(size=131_072)),
        ("2MIB", Rotation(size=2_097_152)),
        ("1GiB", Rotation(size=1 << 30)),
        ("1s", Rotation(age=SECOND)),
        ("90 s", Rotation(age=90 * SECOND)),
        ("30min", Rotation(age=1800 * SECOND)),
        ("0.5h", Rotation(age=1800 * SECOND)),
        ("24H", Rotation(age=86_400 * SECOND)),
    ],
)
def test_a_part_is_full_at_a_size_or_a_time(text: str, rotation: Rotation) -> None:
    assert rotation_at(text) == rotation


def recorded(
    protocol: Protocol,
    path: Path,
    events: list[Event],
    settings: dict[str, Any],
    rotation: Rotation | None,
    patience: int = 0,
) -> None:
    """Record events, each when it comes, as sniff does."""
    decoder = StreamDecoder(protocol, **settings)
    timeout = settings["timeout"]
    metadata = session_metadata(
        protocol,
        ports={},
        line="",
        timeout=round(protocol.timing.truncation_timeout * MS) if timeout is None else timeout,
        skew=settings["skew"],
        heard=settings["heard"],
        attached=settings["attached"],
    )
    with Recorder(path, START, metadata, rotation) as recorder:
        pipeline = Pipeline(decoder, Shown(Output()), recorder, None, patience)
        for event in events:
            pipeline.events([event])
            pipeline.tick(event.t)
        pipeline.finish()
    assert recorder.failure == ""
    assert recorder.bytes == sum(len(event.data) for event in events if isinstance(event, Chunk))


def records(
    protocol: Protocol, capture: Capture, settings: dict[str, Any], *, attached: bool
) -> list[Record]:
    decoder = StreamDecoder(protocol, **settings | {"attached": attached})
    parts = [part for event in capture.events() for part in decoder.feed([event])]
    return records_of([*parts, *decoder.finish()])


def raw(path: Path) -> list[tuple[str, bytes]]:
    """The bytes that a file holds, in order, with who sent them."""
    return [(e.direction, e.data) for e in open_capture(path) if isinstance(e, Chunk)]


@pytest.mark.slow
@limits(max_examples=8)
@given(
    acts=ACTS,
    settings=SETTINGS,
    age=st.sampled_from([5 * MS, 60 * MS, 300 * MS]),
    patience=st.sampled_from([0, 30 * MS]),
)
def test_a_set_of_parts_is_what_one_file_would_have_been(
    protocol: Protocol, acts: Any, settings: dict[str, Any], age: int, patience: int
) -> None:
    events = [event for event in played(protocol, acts) if event.t >= 0]
    with tempfile.TemporaryDirectory() as folder:
        one, several = Path(folder) / "one.mcap", Path(folder) / "several.mcap"
        recorded(protocol, one, events, settings, None, patience)
        recorded(protocol, several, events, settings, Rotation(age=age), patience)
        parts = part_paths(several)
        whole, together = open_capture(one), open_capture(several)
        assert list(together) == list(whole) == events
        assert [chunk for part in parts.values() for chunk in raw(part)] == raw(one)
        said = settings["attached"]
        expected = records(protocol, whole, settings, attached=said)
        assert records(protocol, together, settings, attached=said) == expected
        # From each part on that begins with a checkpoint it goes on as it would have.
        for number in range(2, len(parts) + 1, max(1, len(parts) // 4)):
            part = parts[number]
            for before in range(1, number):
                parts[before].unlink(missing_ok=True)
            begin = next(messages(open_capture(part)), None)
            assert open_capture(part).metadata[topics.PART] == str(number)
            if begin is None or begin.topic != topics.CHECKPOINT:
                continue
            rest = records(protocol, open_capture(several), settings, attached=True)
            assert rest == expected[len(expected) - len(rest) :]


def test_each_part_begins_with_a_checkpoint_and_the_state(
    protocol: Protocol, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    settings = {
        "timeout": None,
        "skew": 0,
        "heard": frozenset({"host", "device"}),
        "attached": False,
    }
    events = list(attached(protocol, Talk(), random.Random(1), 300).events)
    recorded(protocol, path, [*events], settings, Rotation(age=200 * MS))
    parts = part_paths(path)
    assert len(parts) > 5
    seen = 0
    for number, part in parts.items():
        capture = open_capture(part)
        first, *others = messages(capture)
        assert capture.grammar_text == protocol.source
        held = [message.topic for message in others]
        assert held.count("/host/raw") or number == len(parts)
        assert (first.topic == topics.CHECKPOINT) == (number > 1)
        if number > 1:
            assert isinstance(first.value, dict)
            assert first.value["resumes"] is True
            assert capture.metadata[topics.CUT_START] == str(first.t)
            assert "/state" in held or "/host/instructions" not in held
            seen += 1
            # A replay from within the part goes on from a checkpoint of that part or before.
            opened = opened_at(open_quickly(path), protocol, first.t + MS)
            assert opened.after
            assert opened.after.value.t <= first.t + MS
    assert seen == len(parts) - 1


@pytest.mark.waits
def test_an_idle_line_ends_the_part_with_its_traffic_and_makes_no_empty_ones(
    protocol: Protocol, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    metadata = about(protocol, "host")
    with Recorder(path, START, metadata, Rotation(age=SECOND)) as recorder:
        pipeline = Pipeline(StreamDecoder(protocol), Shown(Output()), recorder)
        pipeline.events([Line(0, "open"), Chunk(MS, "host", b"\x20")])
        for second in range(1, 60):
            pipeline.advance(second * SECOND)
        until(lambda: recorder.path.name == "a.00002.mcap")
        pipeline.events([Chunk(60 * SECOND, "host", b"\x20")])
        pipeline.advance(60 * SECOND + 999 * MS)
        pipeline.advance(61 * SECOND)
        until(lambda: recorder.path.name == "a.00003.mcap")
        pipeline.finish()
    assert [len(raw(part)) for part in part_paths(path).values()] == [1, 1, 0]
    starts = [
        open_capture(part).metadata.get(topics.CUT_START) for part in part_paths(path).values()
    ]
    assert starts == [None, str(SECOND), str(61 * SECOND)]


def written_out(recorder: Recorder, chunk: Chunk) -> None:
    """Record a chunk, and wait until it is in the file."""
    part = recorder.path
    size = part.stat().st_size + len(chunk.data)
    recorder.events([chunk])
    until(lambda: part.stat().st_size >= size or recorder.path != part)


@pytest.mark.waits
def test_a_part_ends_soon_after_its_size(protocol: Protocol, tmp_path: Path) -> None:
    path, draw = tmp_path / "a.mcap", random.Random(1)
    metadata = about(protocol, "host")
    said = b""
    with Recorder(path, START, metadata, Rotation(size=60_000)) as recorder:
        for t in range(24):
            data = draw.randbytes(10_000)
            said += data
            written_out(recorder, Chunk(t * MS, "host", data))
            recorder.checkpoint(t * MS, lambda: None)
    files = list(part_paths(path).values())
    assert len(files) >= 3
    assert all(60_000 <= file.stat().st_size < 90_000 for file in files[:-1])
    assert b"".join(data for _, data in raw(path)) == said
