"""Opens a capture at a moment: from the last checkpoint before it on, where there is one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from bilprov.analyzer.decode import checkpoint
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.replay.capture_session import capture_decoder
from bilprov.captures.reader import Capture, StoredCheckpoint, open_capture
from bilprov.captures.schemas import Chunk, Line, Recorded, look_class
from bilprov.captures.text import printable
from bilprov.captures.topics import CHECKPOINT
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.captures.events import Events


class Opened(NamedTuple):
    """A capture, and a decoder that stands at its beginning or at a checkpoint.

    `note` is a sentence for the user, "" if there is none. `after` is the checkpoint that the
    decoder has gone on from, None at the beginning.
    """

    capture: Capture
    decoder: StreamDecoder
    note: str = ""
    after: StoredCheckpoint | None = None

    def events(self) -> Iterator[Chunk | Line]:
        """The events from there on, one by one."""
        return self.capture.events(self.after)

    def batches(self) -> Iterator[Events]:
        """The events from there on, as arrays."""
        return self.capture.batches(self.after)

    def recorded(self, protocol: Protocol) -> Iterator[Recorded]:
        """All that was recorded from there on and not decoded from the bytes."""
        return self.capture.recorded(self.after, look_class(protocol.state_type))


def opened_at(
    capture: Capture, protocol: Protocol, start: int, timeout: int | None = None
) -> Opened:
    """Prepare to decode what comes from `start` (ns since the capture's start) on.

    Only a capture that was opened by its index has checkpoints to go on from; without a fitting
    one it is opened again, as a whole. `timeout` is as in `capture_timeout`. A checkpoint that does
    not fit this protocol or these settings is not used. Raises CaptureError as `open_capture` does.
    """
    if capture.indexes:
        opened = _from_checkpoint(capture, protocol, start, timeout)
        if opened is not None:
            return opened
        capture = open_capture(capture.path)
    note = ""
    if not capture.contents.counts.get(CHECKPOINT):
        note = (
            f"{printable(capture.path)} has no checkpoints, so all of it is decoded up to --start, "
            "which is slow in a long capture"
        )
    return Opened(capture, capture_decoder(capture, protocol, timeout), note)


def _from_checkpoint(
    capture: Capture, protocol: Protocol, start: int, timeout: int | None
) -> Opened | None:
    stored = capture.checkpoint_before(start, protocol.sha256)
    if stored is None:
        return None
    state = checkpoint.decoded(stored.value.decoder, protocol)
    if state is None or state.time > stored.value.t:
        return None
    decoder = capture_decoder(capture, protocol, timeout)
    try:
        decoder.resume(state)
    except ValueError:  # it was saved with other settings
        return None
    return Opened(capture, decoder, after=stored)
