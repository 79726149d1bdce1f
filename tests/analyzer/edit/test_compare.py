"""`bilprov compare`: what differs between two captures, and nothing that does not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.edit.compare import FAR, RUN, aligned
from bilprov.analyzer.replay.comparison import Exchange
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from tests.support.car import car_state
from tests.support.commands import command
from tests.support.decoding import Event, conversation

TALK = [(bytes([0x11, n]), b"\0") for n in range(40)] + [(b"\x20", b"\0"), (b"\x90", b"\1")]
# An instruction without an answer, and then so long a silence that none will come.
PAUSE = [(b"", b"")] * 60 + [(b"\x00", b"\0")]
Talk = Sequence[tuple[bytes, bytes]]


def written(path: Path, events: Sequence[Event], heard: str = "device host") -> Path:
    metadata = {"heard": heard, "attached": "no"}
    with CaptureWriter(path, start_wall=0, metadata=metadata, version="1") as writer:
        for event in events:
            if isinstance(event, Chunk) and event.direction in heard:
                writer.chunk(event)
    return path


def compared(
    tmp_path: Path,
    one: Talk,
    other: Talk,
    *options: str,
    latency: int = MS,
    heard: str = "device host",
) -> tuple[int, dict[str, Any]]:
    """The exit code and the JSON for two conversations."""
    first = written(tmp_path / "a.mcap", conversation(one))
    second = written(tmp_path / "b.mcap", conversation(other, 30 * MS, latency), heard)
    done = command("capture", "diff", str(first), str(second), "--json", "-", *options)
    assert done.stderr == b""
    told = json.loads(done.stdout)
    assert told["exit"] == done.returncode
    return done.returncode, told


def test_the_same_conversation_at_another_pace_does_not_differ(tmp_path: Path) -> None:
    code, told = compared(tmp_path, TALK, TALK, latency=20 * MS)
    assert (code, told["differences"], told["same"], told["judged"]) == (0, {}, 42, 42)
    speeds = told["latencies"]["Speed"]
    assert (speeds["a"]["median"], speeds["b"]["median"]) == (0.001, 0.02)
    assert told["latencies"]["unused 9"]["b"]["count"] == 1


@pytest.mark.parametrize(
    ("change", "kind", "a", "b"),
    [
        (TALK[:7] + TALK[8:], "only_a", "00", None),
        ([*TALK[:7], (b"\x30", b"\0"), *TALK[7:]], "only_b", None, "00"),
        ([*TALK[:7], (b"\x11\x07", b"\2"), *TALK[8:]], "answer", "00", "02"),
        ([*TALK[:-1], (b"\x90", b""), *PAUSE], "answer", "01", None),
        ([*TALK[:7], (b"\x11\x07", b"\0\0"), *TALK[8:]], "unasked", "00", "00"),
    ],
)
def test_one_difference_is_told_as_one(
    tmp_path: Path, change: Talk, kind: str, a: str | None, b: str | None
) -> None:
    one = [*TALK, *PAUSE] if len(change) > len(TALK) + 1 else TALK
    code, told = compared(tmp_path, one, change)
    assert (code, told["differences"]) == (1, {kind: 1})
    (listed,) = told["listed"]
    assert listed["kind"] == kind
    assert (listed["a"] or {}).get("answer") == a
    assert (listed["b"] or {}).get("answer") == b


def test_latencies_differ_beyond_the_tolerance(tmp_path: Path) -> None:
    code, told = compared(tmp_path, TALK, TALK, "--latency", "3", latency=5 * MS)
    assert (code, told["differences"]) == (1, {"latency": 42})
    assert told["listed"][0]["a"]["latency"] == 0.001
    for path in tmp_path.iterdir():
        path.unlink()
    code, told = compared(tmp_path, TALK, TALK, "--latency", "4", latency=5 * MS)
    assert (code, told["differences"]) == (0, {})


def test_where_only_one_holds_answers_nothing_was_judged(tmp_path: Path) -> None:
    code, told = compared(tmp_path, TALK, TALK, heard="host")
    assert (code, told["same"], told["judged"], told["unknown"]) == (3, 42, 0, 42)
    for path in tmp_path.iterdir():
        path.unlink()
    assert compared(tmp_path, TALK, TALK[:-1], heard="host")[0] == 1


REST = car_state("stopped", 0, 0, 0)


def stream(keys: Sequence[int]) -> list[Exchange]:
    return [
        Exchange(HostRecord(n, n, n, "instruction", bytes([key]), None, None, REST))
        for n, key in enumerate(keys)
    ]


_edit = st.tuples(st.integers(0, 4000), st.sampled_from(["drop", "add", "change"]))


@given(
    keys=st.lists(st.integers(0, 5), max_size=3 * RUN) | st.just(list(range(250)) * 12),
    edits=st.lists(_edit, max_size=12),
)
def test_streams_are_aligned_with_no_more_edits_than_were_made(
    keys: list[int], edits: list[tuple[int, str]]
) -> None:
    changed = list(keys)
    for at, kind in edits:
        place = at % (len(changed) + 1)
        if kind != "add":
            del changed[place : place + 1]
        if kind != "drop":
            changed.insert(place, 7)
    one, other = stream(keys), stream(changed)
    pairs = list(aligned(iter(one), iter(other)))
    assert [first for first, _ in pairs if first] == one
    assert [second for _, second in pairs if second] == other
    assert all(first.key == second.key for first, second in pairs if first and second)
    made = sum(2 if kind == "change" else 1 for _, kind in edits)
    if len(keys) > 3 * RUN:  # short ones repeat themselves, where any 16 will do
        assert sum(not (first and second) for first, second in pairs) <= made


@pytest.mark.sample(2)
@pytest.mark.parametrize("missing", [RUN, 300, FAR // 2, FAR - 2 * RUN])
def test_what_follows_many_missing_frames_is_aligned_again(missing: int) -> None:
    draw = Random(missing)
    keys = [draw.randrange(256) for _ in range(2 * FAR)]
    one, other = stream(keys), stream(keys[:50] + keys[50 + missing :])
    for streams in ((one, other), (other, one)):
        pairs = list(aligned(*map(iter, streams)))
        assert sum(not (first and second) for first, second in pairs) <= missing + 2 * RUN


def test_streams_that_have_nothing_in_common_are_told_in_whole() -> None:
    one, other = stream([1] * (FAR + 5)), stream([2] * 500)
    pairs = list(aligned(iter(one), iter(other)))
    assert [first for first, _ in pairs if first] == one
    assert [second for _, second in pairs if second] == other
