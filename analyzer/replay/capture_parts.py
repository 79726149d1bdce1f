"""Reads a whole capture, or a window of it, in batches; memory does not grow with it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from bilprov.analyzer.columns.decoder import Part
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.analyzer.replay.playback import BATCH_BYTES, batches, played
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol

TEXT_BATCH = 1 << 15
"""Bytes of the line to decode at once where rows are made of them: those take 300 times as much."""

WHOLE = Window()

Progress = Callable[[int], object]
"""Told how many bytes of the line were read more; what it raises ends the work."""


def event_batches(
    capture: Capture,
    progress: Progress,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[list[Chunk | Line]]:
    """Yield the events that decoding a window needs, in batches of at most about `largest` bytes.

    Raises CaptureError as `Capture.events` does.
    """
    events = played(capture.events(), 0, sleep=time.sleep, start=window.first, end=window.after)
    for batch in batches(events, at_once=True, largest=largest):
        yield batch
        progress(sum(len(event.data) for event in batch if isinstance(event, Chunk)))


def decoded_parts(
    capture: Capture,
    protocol: Protocol,
    progress: Progress,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[Part]:
    """Yield all that is decoded from these events, part by part, also outside the window."""
    decoder = capture_decoder(capture, protocol)
    for batch in event_batches(capture, progress, window, largest):
        yield from decoder.feed(batch)
    yield from decoder.finish()
