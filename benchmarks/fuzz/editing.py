"""The target that makes new captures of foreign ones: a filter's part, joined, compared."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache
from pathlib import Path

from benchmarks.fuzz.capture_mutator import mutated_capture
from benchmarks.fuzz.captures import capture_file, capture_seeds, own_captures
from benchmarks.fuzz.engine import Target, Test, folder, require
from bilprov.analyzer.edit.compare import compared
from bilprov.analyzer.edit.cut import write_selected
from bilprov.analyzer.edit.exchanges import exchanges
from bilprov.analyzer.edit.join import Joined, write_joined
from bilprov.analyzer.edit.new_capture import cut_metadata, new_capture
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.recorder import RecordWriter
from bilprov.analyzer.replay.seek import opened_at
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.schemas import Chunk
from bilprov.spec.errors import UserError


def _told(count: int) -> None:
    """Progress that nobody is shown."""


def editing() -> Test:
    """A capture is like itself; a part of it, and it joined with another, are whole captures."""

    def test(data: bytes) -> Hashable:
        path = capture_file(data)
        capture = open_capture(path)
        protocol = load_protocol()
        one, other = (exchanges(capture, protocol, _told) for _ in range(2))
        alike = compared(one, other, protocol)
        require(alike.exit == 0, "a capture differs from itself")
        return alike.same.bit_length(), _selected(path, capture), _joined(capture)

    return test


def _selected(path: Path, capture: Capture) -> int:
    """How many frames a filter selects. The part holds no byte that the capture does not."""
    protocol = load_protocol()
    test = compile_filter("faulty", protocol).started(capture.start)

    def write(out: RecordWriter) -> int:
        return write_selected(
            lambda t: opened_at(capture, protocol, t), protocol, out, Window(), test, _told
        )

    metadata = cut_metadata(capture, protocol, None, None, "faulty")
    frames, part = _written(capture.start, metadata, write)
    require(_size(part) <= _size(capture), "a part has more bytes than the whole")
    require((frames > 0) <= (_size(part) > 0), "a part has frames and no bytes")
    return frames.bit_length()


def _joined(capture: Capture) -> int | str:
    """How many bytes it and another capture have together; why not where they are refused."""
    protocol = load_protocol()
    try:
        joined = Joined(protocol, [capture, open_capture(_other())])
    except (CaptureError, UserError) as error:
        return type(error).__name__
    size, both = _written(
        joined.start, joined.metadata(), lambda out: write_joined(joined, protocol, out, _told)
    )
    require(size == _size(both), "two captures have other bytes together than was said")
    require(size == _size(capture) + _size(open_capture(_other())), "bytes were lost or doubled")
    return size.bit_length()


def _written(
    start: int, metadata: dict[str, str], write: Callable[[RecordWriter], int]
) -> tuple[int, Capture]:
    """What `write` says that it wrote into a new capture, and that capture, which is whole."""
    new = folder() / "edited.mcap"
    with new_capture(new, start, metadata, load_protocol(), force=True) as out:
        said = write(out)
    made = open_capture(new)
    require(not made.damage and not made.unfinished, "what was written is damaged")
    return said, made


def _size(capture: Capture) -> int:
    return sum(len(event.data) for event in capture.events() if isinstance(event, Chunk))


@cache
def _other() -> Path:
    path = folder() / "other.mcap"
    path.write_bytes(own_captures()[0])
    return path


TARGETS = (Target("edit", editing, (CaptureError,), capture_seeds, mutated_capture, 0.2),)
