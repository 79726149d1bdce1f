"""`bilprov join`: captures put together by time keep every byte, and say where they begin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from bilprov.analyzer.replay.recorder import RecordWriter, session_metadata
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.spec.protocol import Protocol
from tests.support.commands import command
from tests.support.decoding import Event
from tests.support.traffic import ACTS, played

START = 1_790_000_000_000_000_000
BOTH: tuple[Direction, Direction] = ("host", "device")


def written(
    path: Path,
    protocol: Protocol,
    events: Sequence[Event],
    heard: Sequence[Direction] = BOTH,
    start: int = START,
    **more: str,
) -> Path:
    """A capture of those directions; the times of the events count from START."""
    path.unlink(missing_ok=True)
    ports = {side: f"/dev/{side}" for side in heard}
    about = session_metadata(protocol, ports=ports, line="", timeout=50 * MS, skew=0, heard=heard)
    with RecordWriter(path, start, about | more) as out:
        for event in events:
            if isinstance(event, Line) or event.direction in heard:
                out.event(replace(event, t=event.t + START - start))
    return path


def joined(*paths: Path, code: int = 0, grammar: Sequence[str] = ()) -> str:
    out = paths[0].with_name("joined.mcap")
    done = command(*grammar, "capture", "join", *map(str, paths), "-o", str(out), "--force")
    assert (done.returncode, done.stdout) == (code, b""), done.stderr
    return done.stderr.decode()


def chunks(path: Path, side: str) -> list[tuple[int, bytes]]:
    """The chunks of a side with their wall-clock times."""
    capture = open_capture(path)
    events = capture.events()
    return [
        (capture.start + event.t, event.data)
        for event in events
        if isinstance(event, Chunk) and event.direction == side
    ]


@pytest.mark.slow
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(acts=ACTS, later=st.integers(0, 3000), shift=st.integers(0, 5000))
def test_two_taps_and_what_follows_them_keep_every_chunk(
    protocol: Protocol, tmp_path: Path, acts: Any, later: int, shift: int
) -> None:
    events = [event for event in played(protocol, acts) if event.t >= 0]
    last = max((event.t for event in events), default=0) + 9_000 * MS
    after = [Chunk(last, "host", b"\x20"), Chunk(last + later * MS, "device", b"\0")]
    parts = (
        written(tmp_path / "h.mcap", protocol, events, ["host"]),
        written(tmp_path / "d.mcap", protocol, events, ["device"], START - shift * MS),
        written(tmp_path / "l.mcap", protocol, after, BOTH, START + last - shift * MS // 2),
    )
    joined(*parts)
    out = tmp_path / "joined.mcap"
    for side in BOTH:
        assert sorted(chunks(out, side)) == sorted(c for part in parts for c in chunks(part, side))
    assert open_capture(out).start == START - shift * MS


def test_the_same_direction_at_the_same_time_is_refused_with_what_to_do(
    protocol: Protocol, tmp_path: Path
) -> None:
    events = [Chunk(n * 100 * MS, "host", b"\x20") for n in range(20)]
    one = written(tmp_path / "a.mcap", protocol, events[:12])
    two = written(tmp_path / "b.mcap", protocol, events[8:], start=START + 300 * MS)
    inside = written(tmp_path / "c.mcap", protocol, events[2:5])
    said = joined(two, one, code=2)
    assert "both hold the host and device at the same time" in said
    assert said.count("\n") == 1
    options = said.rsplit("bilprov capture cut ", 1)[1].split()
    assert options[0] == str(two)
    options[1] = str(tmp_path / "rest.mcap")
    assert command("capture", "cut", *options).returncode == 0
    joined(one, tmp_path / "rest.mcap")
    assert [t - START for t, _ in chunks(tmp_path / "joined.mcap", "host")] == [
        event.t for event in events
    ]
    assert f"leave out {inside}" in joined(one, inside, code=2)
    assert "both hold" in joined(one, one, code=2)


def test_attachments_of_all_are_kept(tmp_path: Path) -> None:
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path in paths:
        with RecordWriter(path, START + (path is paths[1]) * 2, {"heard": "host"}) as out:
            out.chunk(Chunk(1, "host", b"\x20"))
            out.attach(f"{path.stem}.txt", "text/plain", path.name.encode(), 5)
    joined(*paths)
    found = open_capture(tmp_path / "joined.mcap").attachments()
    assert [(file.name, file.data) for file in found] == [
        ("a.txt", b"a.mcap"),
        ("b.txt", b"b.mcap"),
    ]
