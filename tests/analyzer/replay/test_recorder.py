"""The recorder of a live session: what is written, when it stops and resumes, and what it costs."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
import pytest

from bilprov.analyzer.decode.records import HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.replay.recorder import (
    CHECKPOINT_AFTER,
    CHECKPOINT_BYTES,
    CHECKPOINT_STATE,
    SECOND,
    Recorder,
    Throttle,
)
from bilprov.captures.reader import open_capture, open_indexed
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.codec import all_data, raw_frame
from bilprov.spec.protocol import Protocol
from tests.support.captures import about
from tests.support.messages import Message, messages

pytestmark = pytest.mark.slow  # more than make quick has time for

STOPPED, RESUMED = "decoded topics stopped", "decoded topics resumed"
START = 1_790_000_000_000_000_000


@pytest.fixture
def recorder(protocol: Protocol, tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(tmp_path / "a.mcap", START, about(protocol)) as recorder:
        yield recorder


def changes(batches: Iterable[tuple[int, int]]) -> list[tuple[int, str]]:
    """When the topics stop and resume (ms), for batches of frames until a time in ms."""
    throttle = Throttle()
    told = ((at, throttle.count(frames, at * MS)) for frames, at in batches)
    return [(at, change[0]) for at, change in told if change]


def steady(rate: int, first: int, last: int) -> list[tuple[int, int]]:
    """Traffic of `rate` frames/s from second `first` to `last`, in a batch each 50 ms."""
    return [(rate // 20, at) for at in range(first * 1000 + 50, last * 1000 + 1, 50)]


@pytest.mark.parametrize(
    ("batches", "expected"),
    [
        (steady(2_000, 0, 30), []),
        (steady(2_020, 0, 30), [(1_000, STOPPED)]),
        (steady(40_000, 0, 30), [(100, STOPPED)]),
        ([(2_001, 700)], [(700, STOPPED)]),
        ([(1_500, 90_000), (1_500, 90_900)], [(90_900, STOPPED)]),
        ([(2_000, 500), (2_000, 1_500)], []),
        (steady(4_000, 0, 1) + steady(980, 1, 9), [(550, STOPPED), (6_050, RESUMED)]),
        (steady(4_000, 0, 1) + steady(1_000, 1, 30), [(550, STOPPED)]),
        (steady(4_000, 0, 1) + steady(0, 1, 9), [(550, STOPPED), (6_050, RESUMED)]),
        (
            steady(4_000, 0, 1) + steady(980, 1, 4) + steady(1_500, 4, 5) + steady(980, 5, 30),
            [(550, STOPPED), (10_050, RESUMED)],
        ),
        (
            [*steady(4_000, 0, 1), (0, 100_000), *steady(4_000, 100, 101)],
            [(550, STOPPED), (100_000, RESUMED), (100_550, STOPPED)],
        ),
        ([(9_000, 10), (9_000, 100_000)], [(10, STOPPED)]),
    ],
)
def test_the_topics_stop_over_2000_frames_in_a_second_and_resume_after_5_below_1000(
    batches: list[tuple[int, int]], expected: list[tuple[int, str]]
) -> None:
    assert changes(batches) == expected


def records_of(protocol: Protocol, frames: int, t: int) -> list[Record]:
    """The records of so many frames of the shortest instruction, all sent at `t`."""
    spec = min(protocol.instructions, key=lambda spec: spec.length)
    data = raw_frame(protocol, spec.id, spec.length, next(iter(all_data(spec))))
    records = Session(protocol, timeout=50 * MS).feed(Chunk(t, "host", data * frames))
    return [record for record in records if isinstance(record, HostRecord)]


def of_topic(messages: Iterable[Message], topic: str) -> list[Message]:
    return [message for message in messages if message.topic == topic]


def test_while_the_topics_are_stopped_the_raw_bytes_alone_are_written_and_faults_says_so(
    protocol: Protocol, tmp_path: Path
) -> None:
    asked = []

    def records(frames: int, t: int) -> Iterable[Record]:
        asked.append(t)
        return records_of(protocol, frames, t)

    with Recorder(tmp_path / "a.mcap", START, about(protocol)) as recorder:
        for at, frames in [(1, 3), (2, 2_500), (3, 5), (1_100, 0), (7_000, 4)]:
            t = at * MS
            recorder.events([Chunk(t, "host", b"x" * frames), Line(t, "modem", "host", str(at))])
            recorder.decoded(frames, t, lambda frames=frames, t=t: records(frames, t))  # type: ignore[misc]
        recorder.tick(20 * SECOND)
        assert recorder.bytes == 3 + 2_500 + 5 + 4
    assert asked == [1 * MS, 7_000 * MS]
    written = list(messages(open_capture(recorder.path)))
    assert [m.t // MS for m in of_topic(written, "/host/raw")] == [1, 2, 3, 1_100, 7_000]
    assert [m.t // MS for m in of_topic(written, "/line")] == [1, 2, 3, 1_100, 7_000]
    assert [m.t // MS for m in of_topic(written, "/host/instructions")] == [1] * 3 + [7_000] * 4
    # The state is said anew, since nobody knows what came in between.
    assert [m.t // MS for m in of_topic(written, "/state")] == [1, 7_000]
    told = [m.value for m in of_topic(written, "/faults") if m.t // MS in (2, 7_000)]
    assert all(isinstance(value, dict) for value in told)
    assert [(v["name"], v["level"]) for v in told if isinstance(v, dict)] == [
        (STOPPED, 2),
        (RESUMED, 2),
    ]
    assert "2,503 host frames within a second" in str(told[0])
    assert isinstance(told[0], dict)
    assert told[0]["timestamp"] == {"sec": START // SECOND, "nsec": 2 * MS}


def test_the_raw_bytes_of_a_batch_stand_before_what_is_decoded_from_them(
    protocol: Protocol, recorder: Recorder
) -> None:
    (record,) = records_of(protocol, 1, 5)
    assert isinstance(record, HostRecord)
    recorder.events([Chunk(5, "host", record.data)])
    recorder.decoded(1, 5, lambda: [record])
    recorder.checkpoint(5 + CHECKPOINT_AFTER, lambda: "{}")
    recorder.close()
    order = [message.topic for message in messages(open_capture(recorder.path))]
    assert order == ["/host/raw", "/host/instructions", "/state", "/checkpoint"]


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        # Bytes that come, and the time in ms of the call after them.
        ([(1, 100), (1, 899), (1, 900), (1, 1_700), (1, 1_800)], [900, 1_800]),
        ([(0, 900), (0, 5_000), (1, 5_001), (0, 9_000)], [5_001]),
        ([(4_096, at) for at in range(1, 41)], [15, 30]),
        ([(200_000, 1), (0, 2), (200_000, 3)], [1, 3]),
    ],
)
def test_a_checkpoint_is_due_each_second_with_traffic_and_each_64_kib(
    recorder: Recorder, steps: list[tuple[int, int]], expected: list[int]
) -> None:
    saved = []
    for size, at in steps:
        recorder.events([Chunk(at * MS, "device", b"x" * size)])
        recorder.checkpoint(at * MS, lambda at=at: saved.append(at) or "{}")  # type: ignore[misc,func-returns-value]
    recorder.close()
    assert saved == expected
    written = of_topic(messages(open_capture(recorder.path)), "/checkpoint")
    assert [message.t // MS for message in written] == expected
    assert CHECKPOINT_BYTES + 4_096 <= 64 * 1024


def test_a_checkpoint_that_cannot_be_made_now_is_tried_at_the_next_call(recorder: Recorder) -> None:
    states = iter([None, None, '{"a":1}'])
    recorder.events([Chunk(0, "host", b"x")])
    for at in range(5):
        recorder.checkpoint(SECOND + at, lambda: next(states))
    recorder.close()
    (message,) = of_topic(messages(open_capture(recorder.path)), "/checkpoint")
    assert message.t == SECOND + 2


def test_a_checkpoint_can_be_found_and_is_of_the_grammar_in_use(
    protocol: Protocol, recorder: Recorder
) -> None:
    state = '{"held":"81 \\u00e5"}'
    recorder.events([Chunk(0, "host", b"x")])
    recorder.checkpoint(SECOND, lambda: state)
    recorder.events([Chunk(SECOND, "host", b"after")])
    recorder.close()
    capture = open_indexed(recorder.path)
    assert capture is not None
    found = capture.checkpoint_before(SECOND + 1, protocol.sha256)
    assert found is not None
    assert (found.value.decoder, found.value.grammar) == (state, protocol.sha256)
    assert list(capture.events(found)) == [Chunk(SECOND, "host", b"after")]


@pytest.mark.parametrize(
    ("size", "written"),
    [(CHECKPOINT_STATE, 1), (CHECKPOINT_STATE + 1, 0)],
    ids=["fits", "too long"],
)
def test_a_state_too_long_for_a_message_is_no_checkpoint_and_no_fault(
    recorder: Recorder, size: int, written: int
) -> None:
    state = msgspec.json.encode(["a"] * (size // 4 - 1)).decode()
    state = state[:-1] + " " * (size - len(state)) + "]"  # nearly all of it escaped
    recorder.events([Chunk(0, "host", b"x")])
    recorder.checkpoint(SECOND, lambda: state)
    recorder.close()
    counts = open_capture(recorder.path).contents.counts
    assert (counts["/checkpoint"], counts["/faults"]) == (written, 0)


@pytest.mark.parametrize(("size", "most"), [(4_096, 2), (16, 8)])
@pytest.mark.parametrize("byte_time", [833, 86_806], ids=["12 Mbaud", "115,200 baud"])
def test_a_frame_of_random_traffic_costs_few_bytes_on_disk(
    protocol: Protocol, recorder: Recorder, size: int, most: int, byte_time: int
) -> None:
    draw = random.Random(1)
    kinds = [
        [raw_frame(protocol, spec.id, spec.length, data) for data in all_data(spec)]
        for spec in protocol.instructions
    ]
    codes = [response.code for response in protocol.responses]
    frames = 100_000 if size > 16 else 30_000
    host = b"".join(
        draw.randbytes(2) if draw.random() < 0.05 else draw.choice(draw.choice(kinds))
        for _ in range(frames)
    )
    device = bytes(draw.choice(codes) if draw.random() < 0.05 else codes[0] for _ in range(frames))
    reads = [
        Chunk(at * byte_time, "host", host[at : at + size]) for at in range(0, len(host), size)
    ]
    for chunk in reads:
        part = len(host) // size + 1
        number = chunk.t // byte_time // size
        answers = device[number * frames // part : (number + 1) * frames // part]
        recorder.events([chunk, Chunk(chunk.t + byte_time, "device", answers)])
        recorder.checkpoint(chunk.t + byte_time, lambda: '{"state":"%s"}' % ("s" * 300))
    recorder.close()
    capture = open_capture(recorder.path)
    assert capture.contents.sizes["/device/raw"] == frames
    assert capture.contents.counts["/checkpoint"] >= len(host) // (64 * 1024)
    assert recorder.path.stat().st_size <= most * frames
