"""Replay from a checkpoint on: the same lines as a full replay from there on."""

from __future__ import annotations

import random
from pathlib import Path

import msgspec
import pytest

from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.outputs import Output, Shown, StreamOutput, Window, json_text
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_decoding import opened_at, paced
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.captures.reader import open_capture, open_quickly
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.captures.topics import CHECKPOINT
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support import ROOT

START = 1_790_000_000_000_000_000
TIMEOUT, SKEW = 50 * MS, 20 * MS


def made(
    protocol: Protocol, path: Path, seed: int, *, attached: bool = False, judged: bool = False
) -> Path:
    """A capture of some seconds with checkpoints: busy and quiet, with whatever can go wrong."""
    draw = random.Random(seed)
    metadata = session_metadata(
        protocol,
        ports={},
        line="",
        timeout=TIMEOUT,
        skew=SKEW,
        heard=("host", "device"),
        attached=attached,
    )
    decoder = StreamDecoder(protocol, timeout=TIMEOUT, skew=SKEW, attached=attached)
    with Recorder(path, START, metadata) as recorder:
        pipeline = Pipeline(
            decoder,
            Shown(Output()),
            recorder,
            PassiveJudge(protocol, paired=True, attached=attached) if judged else None,
            patience=draw.choice([0, 50 * MS]),
        )
        t = 0
        while t < 6_000 * MS:
            events, t = _turn(protocol, draw, t)
            pipeline.events(events)
            pipeline.advance(t)
        pipeline.finish()
    return path


def _turn(protocol: Protocol, draw: random.Random, t: int) -> tuple[list[Chunk | Line], int]:
    """Some events from `t` on, and when they are over."""
    frames = []
    for _ in range(draw.choice([1, 1, 1, 3, 400])):
        header = draw.randrange(256)
        frames.append(bytes([header]) + draw.randbytes(protocol.lengths[header]))
    said = b"".join(frames)
    answers = bytes(judge(protocol, frame).response.code for frame in frames)
    if draw.random() < 0.05:
        said = said[: draw.randrange(1, len(said) + 1)]
    if draw.random() < 0.05:
        answers = draw.randbytes(1) + answers[draw.randrange(2) :]
    events: list[Chunk | Line] = [Chunk(t, "host", said)]
    t += draw.choice([MS, MS, 5 * MS])
    if draw.random() < 0.95:
        events.append(Chunk(t, "device", answers))
    if draw.random() < 0.02:
        events.append(Line(t, draw.choice(["gap", "break", "overrun"])))
    return events, t + draw.choice([1, MS, 20 * MS, 60 * MS, 200 * MS])


def lines(path: Path, protocol: Protocol, start: int, *, seek: bool) -> list[str]:
    """The JSON lines of a replay from `start` (ns) on."""
    text: list[str] = []
    opened = opened_at(open_quickly(path), protocol, start if seek else 0)
    pipeline = Pipeline(
        opened.decoder,
        Shown(StreamOutput(text.append, json_text), window=Window(start)),
    )
    for event in opened.capture.events(opened.after):
        pipeline.events([event])
        pipeline.advance(event.t)
    pipeline.finish()
    return "".join(text).splitlines()


def later(full: list[str], start: int) -> list[str]:
    return [line for line in full if msgspec.json.decode(line)["t"] * 1e9 >= start - 0.5]


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize(("seed", "attached"), [(1, False), (2, True), (3, False), (4, True)])
@pytest.mark.parametrize("judged", [False, True])
def test_the_lines_from_a_checkpoint_are_those_of_a_full_replay(
    protocol: Protocol, tmp_path: Path, seed: int, attached: bool, judged: bool
) -> None:
    path = made(protocol, tmp_path / "made.mcap", seed, attached=attached, judged=judged)
    assert open_capture(path).contents.counts[CHECKPOINT] >= 5
    full = lines(path, protocol, 0, seek=False)
    draw = random.Random(seed)

    for start in (draw.randrange(6_500 * MS) for _ in range(3)):
        assert lines(path, protocol, start, seek=True) == later(full, start)


@pytest.mark.slow
def test_what_stands_before_the_checkpoint_is_not_read(protocol: Protocol, tmp_path: Path) -> None:
    path = made(protocol, tmp_path / "made.mcap", 5)
    all_events = sum(1 for _ in open_capture(path))

    opened = opened_at(open_quickly(path), protocol, 5_000 * MS)

    assert sum(1 for _ in opened.capture.events(opened.after)) < all_events / 3


@pytest.mark.parametrize("sample", sorted((ROOT / "captures" / "samples").glob("*.mcap")))
def test_an_older_capture_is_replayed_without_checkpoints(protocol: Protocol, sample: Path) -> None:
    full = lines(sample, protocol, 0, seek=False)
    draw = random.Random(sample.name)

    for start in (draw.randrange(2_000 * MS) for _ in range(20)):
        assert lines(sample, protocol, start, seek=True) == later(full, start)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("lie", ["grammar", "crc", "nonsense", "settings"])
def test_a_checkpoint_that_lies_is_not_believed(
    protocol: Protocol, tmp_path: Path, lie: str
) -> None:
    honest = made(protocol, tmp_path / "made.mcap", 6)
    lying = tmp_path / "lying.mcap"
    capture = open_capture(honest)
    about = {key: text for key, text in capture.metadata.items() if key != "start"}
    with CaptureWriter(lying, start_wall=START, metadata=about, version="1") as writer:
        for value in capture.recorded():
            if isinstance(value, Chunk):
                writer.chunk(value)
            elif isinstance(value, Line):
                writer.write(value, value.t)
            else:
                writer.write(_lying(value, lie), value.t)  # type: ignore[arg-type]

    full = lines(lying, protocol, 0, seek=False)
    assert lines(lying, protocol, 4_000 * MS, seek=True) == later(full, 4_000 * MS)


def _lying(value: msgspec.Struct, lie: str) -> msgspec.Struct:
    """A checkpoint with a state that is not true, and one thing that gives it away."""
    state = msgspec.json.decode(value.decoder)  # type: ignore[attr-defined]
    state["sequence"] += 1000
    if lie == "nonsense":
        state["sequence"] = -1
    if lie == "settings":
        state["timeout"] += 1
    text = msgspec.json.encode(state).decode()
    if lie == "crc":
        return msgspec.structs.replace(value, decoder=text)
    grammar = "0" * 64 if lie == "grammar" else value.grammar  # type: ignore[attr-defined]
    return type(value).of(value.t, grammar, text)  # type: ignore[attr-defined, no-any-return]


# -- at which times --------------------------------------------------------------------------------


SECOND = 1_000_000_000
EVENTS = [Chunk(t * SECOND, "host", bytes([t])) for t in (0, 1, 1, 4)]


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 128.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


def played(
    rate: float, *, slow: float = 0.0, start: int | None = None, end: int | None = None
) -> list[tuple[float, int]]:
    clock = Clock()
    seen = []
    for event in paced(EVENTS, rate, clock=clock, sleep=clock.sleep, start=start, end=end):
        seen.append((clock.now - 128, event.data[0]))
        clock.now += slow
    return seen


@pytest.mark.parametrize(
    ("rate", "times"),
    [(1, [0, 1, 1, 4]), (2, [0, 0.5, 0.5, 2]), (0.5, [0, 2, 2, 8]), (0, [0, 0, 0, 0])],
)
def test_each_event_comes_at_its_time_divided_by_the_rate(rate: float, times: list[float]) -> None:
    assert played(rate) == list(zip(times, [0, 1, 1, 4], strict=True))


def test_a_slow_consumer_does_not_shift_what_comes_later() -> None:
    assert played(1, slow=0.75) == [(0, 0), (1, 1), (1.75, 1), (4, 4)]


def test_only_what_is_inside_the_window_waits_and_playing_begins_at_its_start() -> None:
    assert played(1, start=SECOND, end=4 * SECOND) == [(0, 0), (0, 1), (0, 1), (0, 4)]
    assert played(1, start=3 * SECOND) == [(0, 0), (0, 1), (0, 1), (1, 4)]


def test_an_event_that_comes_late_is_played_although_its_time_is_before_the_start() -> None:
    late = [Chunk(0, "host", b"\0"), Chunk(9, "host", b"\1"), Chunk(4, "host", b"\2")]
    clock = Clock()

    seen = list(paced(late, 1, clock=clock, sleep=clock.sleep, start=5))

    assert seen == late


def test_playing_stops_soon_after_the_end_without_reading_on() -> None:
    source = iter([*EVENTS, Chunk(9 * SECOND, "host", b"\7")])
    clock = Clock()
    assert len(list(paced(source, 0, clock=clock, sleep=clock.sleep, end=1))) == 3
    assert len(list(source)) == 1
