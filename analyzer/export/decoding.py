"""Decodes a capture for the exporters of rows: what is in a window of time and passes a filter."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.output.outputs import NoOutput, Shown, Window
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.analyzer.replay.playback import batches, played
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

BATCH = 1 << 16
"""Bytes of the line decoded at once: what is made of them may take up to 300 times as much."""

Progress = Callable[[int], object]
"""Told how many bytes of the line were read more."""


def decoded_parts(
    capture: Capture,
    protocol: Protocol,
    test: Filter | None,
    window: Window,
    progress: Progress,
) -> Iterator[Part]:
    """Yield what `replay` shows of a capture, in order.

    Raises CaptureError as `Capture.events` does.
    """
    shown = Shown(NoOutput(), test, window=window)
    decoder = capture_decoder(capture, protocol)
    events = played(capture.events(), 0, sleep=time.sleep, start=window.first, end=window.after)
    for batch in batches(events, at_once=True, largest=BATCH):
        for part in decoder.feed(batch):
            yield shown.show(part)
        progress(sum(len(event.data) for event in batch if isinstance(event, Chunk)))
    for part in decoder.finish():
        yield shown.show(part)
