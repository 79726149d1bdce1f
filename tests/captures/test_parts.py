"""A recording in several files: read as one, and what is missing or foreign among them is told."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from bilprov.captures import topics
from bilprov.captures.background import BackgroundWriter
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import part_path, part_paths, said_of_parts
from bilprov.captures.reader import Capture, open_capture, open_indexed
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Resumption
from bilprov.captures.writer import CaptureWriter
from tests.support.robots import until

START = 1_790_000_000_000_000_000
SECOND = 1_000_000_000
EVENTS = 40  # in a part


def state(t: int) -> Checkpoint:
    return Checkpoint.of(t, "g", f'{{"at":{t}}}', resumes=True)


def parts(folder: Path, count: int, *, start: int = START, name: str = "drive") -> Path:
    """A recording in so many parts of 40 chunks, one a second; the name under which it is read."""
    path = folder / f"{name}.mcap"
    about = {topics.PART: "1", "heard": "host"}
    writer = CaptureWriter(part_path(path, 1), start_wall=start, metadata=about, version="0")
    for t in range(count * EVENTS):
        if t and t % EVENTS == 0:
            number = t // EVENTS + 1
            about = about | {topics.PART: str(number), topics.CUT_START: str(t * SECOND)}
            writer.go_on_in(part_path(path, number), about)
            writer.write(state(t * SECOND), t * SECOND)
        writer.chunk(Chunk(t * SECOND, "host", b"%d" % t))
    writer.close()
    return path


def chunks(of: Sequence[int]) -> list[Chunk | Line]:
    """The chunks of the parts with these numbers."""
    ranges = (range((n - 1) * EVENTS, n * EVENTS) for n in of)
    return [Chunk(t * SECOND, "host", b"%d" % t) for one in ranges for t in one]


def both_ways(path: Path) -> list[Capture]:
    """The recording as surveyed and as indexed, where it has an index."""
    indexed = open_indexed(path)
    return [open_capture(path), *([indexed] if indexed else [])]


@pytest.mark.parametrize(
    ("name", "first", "others"),
    [
        ("drive.mcap", "drive.00001.mcap", ["drive.1.mcap", "drive.000001.mcap", "drive.mcap.1"]),
        ("drive", "drive.00001", ["drive.00001.mcap", "drive00001", "drive.00001~"]),
        ("a.b.mcap", "a.b.00001.mcap", ["a.00001.mcap", "b.00001.mcap", "aXb.00001.mcap"]),
        ("[a]*.mcap", "[a]*.00001.mcap", ["a.00001.mcap", "[a]b.00001.mcap"]),
    ],
)
def test_parts_have_numbers_in_their_names_that_sort(
    tmp_path: Path, name: str, first: str, others: list[str]
) -> None:
    path = tmp_path / name
    assert part_path(path, 1).name == first
    wanted = [part_path(path, number) for number in (1, 2, 10, 99_999, 100_000)]
    for file in [*reversed(wanted), *(tmp_path / other for other in others)]:
        file.touch()
    assert list(part_paths(path).values()) == wanted
    assert [file.name for file in wanted[:-1]] == sorted(file.name for file in wanted[:-1])
    assert said_of_parts(wanted[:1]) == str(wanted[0])
    assert said_of_parts(wanted[:2]) == f"{wanted[0]} to {wanted[1]}"


def test_a_name_that_cannot_be_looked_for_has_no_parts() -> None:
    for name in ("", "..", "/", "no/such/folder/drive.mcap", "a\0b.mcap", "x" * 5_000):
        assert part_paths(Path(name)) == {}


def test_a_file_of_the_name_comes_before_parts_of_the_name(tmp_path: Path) -> None:
    path = parts(tmp_path, 2)
    part_path(path, 2).rename(path)
    assert list(open_capture(path))[1:] == chunks([2])
    assert [list(capture)[1:] for capture in both_ways(path)] == [chunks([2])] * 2


def test_a_part_that_is_there_under_two_numbers_is_read_once(tmp_path: Path) -> None:
    path = parts(tmp_path, 2)
    part_path(path, 3).write_bytes(part_path(path, 2).read_bytes())
    for capture in both_ways(path):
        assert [event for event in capture if isinstance(event, Chunk)] == chunks([1, 2])


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ([2], "part 2 (drive.00002.mcap) is missing"),
        ([2, 3], "parts 2 to 3 of drive.mcap are missing"),
    ],
)
def test_a_part_that_is_missing_in_between_is_a_gap_behind_which_decoding_is_in_step(
    tmp_path: Path, missing: list[int], words: str
) -> None:
    path = parts(tmp_path, 4)
    for number in missing:
        part_path(path, number).unlink()
    after = missing[-1] + 1
    for capture in both_ways(path):
        assert capture.damage == (words,)
        events = list(capture)
        gap = events.pop(EVENTS)
        assert isinstance(gap, Resumption)
        assert (gap.event, gap.silent, gap.checkpoint) == ("gap", False, state(gap.t))
        assert gap.t == (after - 1) * EVENTS * SECOND
        lost = (EVENTS + 1) * len(missing)
        assert gap.detail == f"{lost} messages are lost here, {words}"
        assert events == chunks([n for n in range(1, 5) if n not in missing])


@pytest.mark.parametrize("left", [0, 8, 60, 300])
def test_a_newest_part_that_was_hardly_begun_says_only_that_it_was_killed(
    tmp_path: Path, left: int
) -> None:
    path = parts(tmp_path, 3)
    os.truncate(part_path(path, 3), left)
    capture = open_capture(path)
    assert list(capture) == chunks([1, 2])
    assert (capture.unfinished, capture.damage) == (True, ())


def test_an_empty_part_in_between_is_refused_by_its_name(tmp_path: Path) -> None:
    path = parts(tmp_path, 3)
    os.truncate(part_path(path, 2), 0)
    with pytest.raises(CaptureError, match=r"drive\.00002\.mcap is empty"):
        open_capture(path)
    assert open_indexed(path) is None


def test_parts_of_different_recordings_are_refused(tmp_path: Path) -> None:
    path = parts(tmp_path, 2)
    parts(tmp_path, 3, start=START + 1, name="other")
    (tmp_path / "other.00003.mcap").rename(tmp_path / "drive.00003.mcap")
    words = r"drive\.00001\.mcap and .*drive\.00003\.mcap are parts of different recordings: "
    with pytest.raises(CaptureError, match=words):
        open_capture(path)
    assert open_indexed(path) is None


def test_parts_that_were_written_anew_lose_nothing(tmp_path: Path) -> None:
    path = parts(tmp_path, 3)
    for number in (2, 3):  # their sequence numbers count from 0 again
        part = part_path(path, number)
        capture = open_capture(part)
        part.unlink()
        with CaptureWriter(
            part, start_wall=START, metadata=capture.metadata, version="0"
        ) as writer:
            for event in chunks([number]):
                assert isinstance(event, Chunk)
                writer.chunk(event)
    for capture in both_ways(path):
        assert list(capture) == chunks([1, 2, 3])


def until_there(capture: BackgroundWriter, number: int) -> None:
    """Wait until the part is written; files are made by the thread behind."""
    part = part_path(capture.path.with_name("a"), number)
    until(lambda: bool(capture.failure) or capture.paths[-1] == part)


def rotating(folder: Path) -> BackgroundWriter:
    path = part_path(folder / "a", 1)
    return BackgroundWriter(CaptureWriter(path, start_wall=START, metadata={}, version="0"))


def turn(capture: BackgroundWriter, number: int, keep: int | None = None) -> None:
    """Write a chunk, and go on in the part of that number."""
    capture.chunk(Chunk(number * SECOND, "host", b"%d" % number))
    capture.go_on_in(part_path(capture.path.with_name("a"), number), {}, number * SECOND, keep)
    assert capture.size == 0 or capture.path.name.endswith(f"{number}")
    until_there(capture, number)


@pytest.mark.waits
def test_the_newest_parts_are_kept_and_only_own_files_deleted(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with rotating(tmp_path) as capture:
        turn(capture, 2, keep=3)
        turn(capture, 3, keep=3)
        assert (capture.oldest, len(capture.paths)) == (0, 3)
        # Another program moves the oldest away, and puts something else there.
        part_path(path, 1).rename(tmp_path / "mine")
        part_path(path, 1).write_bytes(b"precious")
        part_path(path, 2).unlink()  # and deletes the next one
        turn(capture, 4, keep=3)
        turn(capture, 5, keep=3)
        turn(capture, 6, keep=3)
    assert capture.failure == ""
    assert capture.paths == tuple(part_path(path, number) for number in (4, 5, 6))
    assert capture.oldest == 4 * SECOND
    assert part_path(path, 1).read_bytes() == b"precious"
    assert not part_path(path, 2).exists()
    assert not part_path(path, 3).exists()
    assert list(open_capture(tmp_path / "mine")) == [Chunk(2 * SECOND, "host", b"2")]


@pytest.mark.waits
def test_a_part_whose_name_is_taken_ends_the_recording_and_is_not_touched(tmp_path: Path) -> None:
    taken = part_path(tmp_path / "a", 3)
    with rotating(tmp_path) as capture:
        turn(capture, 2)
        taken.write_bytes(b"precious")
        turn(capture, 3)
        capture.chunk(Chunk(4 * SECOND, "host", b"dropped"))
    name = part_path(tmp_path / "a", 2)
    assert capture.failure == (
        f"{taken} exists and captures are never overwritten: choose another name; what was "
        f"captured until 3.0 s is kept in {name}"
    )
    assert taken.read_bytes() == b"precious"
    assert capture.paths == (part_path(tmp_path / "a", 1), name)
    taken.unlink()
    assert list(open_capture(tmp_path / "a")) == [
        Chunk(2 * SECOND, "host", b"2"),
        Chunk(3 * SECOND, "host", b"3"),
    ]
    assert not open_capture(tmp_path / "a").unfinished
