"""Decodes a whole capture into its Totals, in batches, so that memory stays flat. Needs numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from bilprov.analyzer.columns.totals import Totals
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol

# A batch ends with the event that reaches one of these.
_BYTES = 1 << 19
_EVENTS = 4096


def capture_totals(
    capture: Capture, protocol: Protocol, progress: Callable[[int], object] = lambda size: None
) -> Totals:
    """Decode a capture as `replay` does, and count.

    `progress` is told the number of bytes of each batch. Raises CaptureError as `Capture.events`.
    """
    totals = Totals(protocol)
    decoder = capture_decoder(capture, protocol)
    for events, size in _batches(capture.events()):
        for part in decoder.feed(events):
            totals.add(part)
        progress(size)
    for part in decoder.finish():
        totals.add(part)
    return totals


def _batches(events: Iterable[Chunk | Line]) -> Iterator[tuple[list[Chunk | Line], int]]:
    """Yield events together, and how many bytes they have."""
    batch: list[Chunk | Line] = []
    size = 0
    for event in events:
        batch.append(event)
        size += len(event.data) if isinstance(event, Chunk) else 0
        if size >= _BYTES or len(batch) == _EVENTS:
            yield batch, size
            batch, size = [], 0
    yield batch, size
