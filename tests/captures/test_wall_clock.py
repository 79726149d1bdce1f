"""A clock that is set wrong ends no recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.wall_clock import EARLIEST, LATEST, wall_clock
from bilprov.captures.writer import CaptureWriter

NOW = 1_790_000_000_000_000_000


def before_1970() -> int:
    return -3_600_000_000_000


def after_2262() -> int:
    """What Python does with a later time than it can give in ns."""
    raise OverflowError("timestamp out of range for platform time_t")


@pytest.mark.parametrize(
    ("clock", "start"), [(before_1970, EARLIEST), (after_2262, LATEST), (lambda: NOW, NOW)]
)
def test_a_capture_begins_at_the_limit_where_the_clock_is_beyond_it(
    clock: Callable[[], int], start: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    chunk = Chunk(5, "host", b"kept")
    with CaptureWriter(path, start_wall=wall_clock(clock), metadata={}, version="0") as writer:
        writer.chunk(chunk)
    capture = open_capture(path)
    assert (capture.start, list(capture)) == (start, [chunk])
