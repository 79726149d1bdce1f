"""Reads a whole capture, or a window of it, in batches; memory does not grow with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.output.outputs import NoOutput, Shown, Window
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.analyzer.replay.playback import AFTERMATH
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.captures.events import Events

TEXT_BATCH = 1 << 14
"""Bytes of the line to decode at once where rows are made of them: those take 300 times as much."""

BATCH_BYTES = 1 << 18
_BYTES_A_READ = 4  # as many reads as there would be of so many bytes come at once at most
_FIRST_BATCH = 1 << 10  # bytes; so that there is soon something to show

WHOLE = Window()

Progress = Callable[[int], object]
"""Gets how many bytes of the line were read more; what it raises ends the work."""


class Chosen(NamedTuple):
    """What of a capture is exported: the rows in a window that pass a filter (None: all)."""

    capture: Capture
    protocol: Protocol
    test: Filter | None
    window: Window
    progress: Progress

    def batches(self) -> Iterator[Batch]:
        """Yield the rows. Raises CaptureError if the capture cannot be read."""
        shown = Shown(NoOutput(), self.test, window=self.window)
        batches = decoded_batches(
            self.capture, self.protocol, self.progress, self.window, TEXT_BATCH
        )
        return map(shown.show, batches)


def event_batches(
    events: Iterable[Events],
    progress: Progress,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[Events]:
    """Yield those events of a capture that decoding a window needs, about `largest` bytes at once.

    Raises CaptureError as `Capture.batches` does.
    """
    most = min(_FIRST_BATCH, largest)
    for read in events:
        at = 0
        while at < len(read):
            done = int(read.end[at - 1]) if at else 0
            stop = int(read.end.searchsorted(done + most, "right"))
            stop = max(at + 1, min(stop, at + most // _BYTES_A_READ))
            batch, at, most = read.part(at, stop), stop, min(2 * most, largest)
            if window.after is not None:
                late = batch.t > window.after + AFTERMATH
                if late.any():
                    yield batch.part(0, int(late.argmax()))
                    return
            yield batch
            progress(len(batch.data))


def decoded(
    decoder: StreamDecoder,
    events: Iterable[Events],
    progress: Progress = lambda size: None,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[Batch]:
    """Yield all that is decoded from these events, also outside the window."""
    for batch in event_batches(events, progress, window, largest):
        yield from decoder.decode(batch)
    yield from decoder.finish()


def decoded_batches(
    capture: Capture,
    protocol: Protocol,
    progress: Progress,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[Batch]:
    """Yield all that is decoded from a capture, as `decoded` does."""
    decoder = capture_decoder(capture, protocol)
    return decoded(decoder, capture.batches(), progress, window, largest)
