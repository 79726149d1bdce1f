"""Decodes a whole capture into its Totals, in batches, so that memory stays flat. Needs numpy."""

from __future__ import annotations

from collections.abc import Callable

from bilprov.analyzer.columns.totals import Totals
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.analyzer.replay.playback import batches
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol


def capture_totals(
    capture: Capture, protocol: Protocol, progress: Callable[[int], object] = lambda size: None
) -> Totals:
    """Decode a capture as `replay` does, and count.

    `progress` is told the number of bytes of each batch. Raises CaptureError as `Capture.events`.
    """
    totals = Totals(protocol)
    decoder = capture_decoder(capture, protocol)
    for events in batches(capture.events(), at_once=True):
        for part in decoder.feed(events):
            totals.add(part)
        progress(sum(len(event.data) for event in events if isinstance(event, Chunk)))
    for part in decoder.finish():
        totals.add(part)
    return totals
