"""Decodes captures as they were recorded, from the beginning or a moment on, in batches.

The settings of the recording session hold where the file has them. From a moment on decoding begins
at the last checkpoint before it, where there is one. Memory does not grow with a capture. Its
events can be played at recorded, faster or slower time.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from bilprov.analyzer.decode import checkpoint
from bilprov.analyzer.decode.session import BOTH, SKEW, SessionSettings
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import carried_protocol, load_protocol
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.transport.line_settings import LineSettings, line_named
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Chunk, Direction, Line, Look, Recorded, look_class
from bilprov.captures.text import printable
from bilprov.captures.topics import CUT_START, DEVICE_RAW, GRAMMAR_HASH, HOST_RAW
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import GrammarError, Protocol, grammar_hash

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.totals.totals import Totals
    from bilprov.captures.events import Events
    from bilprov.captures.reader import Capture, StoredCheckpoint

Event = Chunk | Line | Look
Paced = TypeVar("Paced", bound=Event)

AFTERMATH = 3_000_000_000
"""Ns after a window's end whose events are still needed to decode what began inside it."""


def paced(
    events: Iterable[Paced],
    rate: float,
    *,
    sleep: Callable[[float], object],
    clock: Callable[[], float] = time.monotonic,
    start: int | None = None,
    end: int | None = None,
) -> Iterator[Paced]:
    """Yield the events needed to decode `start <= t < end` (ns), those inside at their times.

    `rate` 1 is recorded time, 2 twice as fast, 0 without delays. `clock` and `sleep` are in
    seconds, like `time.monotonic` and `time.sleep`. Delays do not add up, since each due time
    counts from the beginning of playing, which is at `start`.

    Events before the window come without delay, because the predicted state and the framing depend
    on them. So do events shortly after it, because they may complete what began inside.
    """
    began: float | None = None
    for event in events:
        if end is not None and event.t > end + AFTERMATH:
            return
        if rate and event.t >= (start or 0) and (end is None or event.t < end):
            began = clock() if began is None else began
            wait = began + (event.t - (start or 0)) / 1e9 / rate - clock()
            if wait > 0:
                sleep(wait)
        yield event


def interruptible(
    stopper: Stopper, meanwhile: Callable[[float], object]
) -> Callable[[float], None]:
    """Make a sleep function (s) that Ctrl-C ends and that reports its progress to `meanwhile`.

    `meanwhile` is called at least ten times a second with the seconds slept so far, which are
    always less than the whole duration.
    """

    def sleep(seconds: float) -> None:
        began = time.monotonic()
        while not stopper.stopped:
            left = began + seconds - time.monotonic()
            if left <= 0:
                return
            select.select([stopper], [], [], min(left, 0.1))
            meanwhile(min(time.monotonic() - began, seconds * 0.999))

    return sleep


_LONGEST = 60_000.0  # ms that a file may ask for


def capture_protocol(captures: Sequence[Capture], in_use: Protocol, origin: str = "") -> Protocol:
    """The grammar by which captures are decoded, which they carry: one for all of them.

    Of captures without a grammar's text it is the one in use (`said_about` tells of a difference).
    `origin` is the name of the grammar's file. Raises GrammarError, in one sentence, for captures
    of different grammars, and as `carried_protocol` does.
    """
    stated = {known: one for one in captures if (known := _hash(one))}
    if len(stated) > 1:
        first, second, *_ = (f"{printable(one.path)} ({_known(one)})" for one in stated.values())
        raise GrammarError(
            f"{first} and {second} were recorded with different grammars: name captures of one, "
            "or give one grammar for all with --grammar FILE.py"
        )
    if in_use.sha256 in stated:  # so that nothing is loaded twice
        return in_use
    for one in captures:
        text = one.grammar_text
        if text and grammar_hash(text) != in_use.sha256:
            told = one.metadata.get(GRAMMAR_HASH, "")
            return carried_protocol(text, told, str(one.path), origin)
    return in_use


def require_known(captures: Sequence[Capture], protocol: Protocol) -> None:
    """Raise GrammarError for captures of another grammar, which they do not carry.

    A copy of them would be taken for one of `protocol`.
    """
    for one in captures:
        if _is_other(one, protocol):
            raise GrammarError(
                f"{printable(one.path)} was recorded with another grammar ({_known(one)}), which "
                "is not in it: give that grammar's file with --grammar FILE.py"
            )


def _is_other(capture: Capture, protocol: Protocol) -> bool:
    """Whether a capture says that it was recorded with another grammar."""
    return _hash(capture) not in ("", protocol.sha256)


def _hash(capture: Capture) -> str:
    """The hash of the grammar that a capture was recorded with, "" if the file does not tell."""
    text = capture.grammar_text
    return capture.metadata.get(GRAMMAR_HASH) or (grammar_hash(text) if text else "")


def _known(capture: Capture) -> str:
    """The grammar that a capture was recorded with, in words."""
    name = capture.metadata.get("grammar_name", "without a name")
    return f"{name} {capture.metadata.get('grammar_version', '')}".strip()


def capture_settings(
    capture: Capture, protocol: Protocol, timeout: int | None = None
) -> SessionSettings:
    """The settings of the recording session; `timeout` is as in `capture_timeout`."""
    skew = _nanoseconds(capture, "skew_ms")
    return {
        "timeout": capture_timeout(capture, protocol, timeout),
        "heard": heard(capture),
        "skew": SKEW if skew is None else skew,
        # Without this entry the first byte need not be a header.
        "attached": capture.metadata.get("attached") != "no",
    }


def capture_decoder(
    capture: Capture, protocol: Protocol, timeout: int | None = None
) -> StreamDecoder:
    """A decoder with the settings of the recording one; `timeout` is as in `capture_timeout`."""
    return StreamDecoder(protocol, **capture_settings(capture, protocol, timeout))


def capture_timeout(capture: Capture, protocol: Protocol, timeout: int | None = None) -> int:
    """The truncation time-out in ns: the one given, else the recorded one, else the protocol's."""
    recorded = _nanoseconds(capture, "truncation_timeout_ms")
    return timeout or recorded or round(protocol.timing.truncation_timeout * MS)


def heard(capture: Capture) -> frozenset[Direction]:
    """The directions that were listened to; if the file does not say, those with bytes."""
    told = capture.metadata.get("heard", "").split()
    if told and set(told) <= BOTH:
        return frozenset(side for side in BOTH if side in told)
    counts = capture.contents.counts
    raw: dict[Direction, str] = {"host": HOST_RAW, "device": DEVICE_RAW}
    return frozenset(side for side, topic in raw.items() if counts.get(topic)) or BOTH


def capture_line(capture: Capture, protocol: Protocol) -> LineSettings:
    """The recorded line settings, or the protocol's own if the file does not say."""
    return line_named(protocol, capture.metadata.get("line", ""))


def require_begun(capture: Capture, start: int | None) -> None:
    """Raise UserError where a `start` (ns since the capture's) is behind the capture's end."""
    end = max(0, capture.contents.last - capture.start)
    if start is not None and start > end:
        raise UserError(
            f"{printable(capture.path)} ends at {end / 1e9:.3f} s, which is before --start "
            f"{start / 1e9:g}; give a start before its end"
        )


def said_about(capture: Capture, protocol: Protocol, *, is_written: bool = False) -> Iterator[str]:
    """Yield notes for the user about the file, each one line: unfinished, empty, damaged, other.

    A capture that is still being written (`is_written`) may well be unfinished and empty.
    """
    name = printable(capture.path)
    gone = capture.number(CUT_START)
    if gone is not None and capture.in_parts:
        first = printable(capture.volumes[0].path.name)
        yield f"{name} begins at {gone / 1e9:.3f} s with {first}: older parts are not there"
    if capture.unfinished and not is_written:
        yield f"{name} was never finished: everything intact is shown"
    traffic = any(capture.contents.counts.get(topic) for topic in (HOST_RAW, DEVICE_RAW))
    if not traffic and not is_written:
        yield f"{name} holds no traffic: not a byte of host or device is in it"
    if capture.damage:
        first = capture.damage[0]
        more = f" and {len(capture.damage) - 1} more" if len(capture.damage) > 1 else ""
        yield f"{name} is damaged: {first}{more}; the rest is shown"
    if other := said_of_other(capture, protocol):
        yield other


def said_of_other(capture: Capture, protocol: Protocol) -> str:
    """A note that the capture was recorded with another grammar than this, "" if it was not."""
    if not _is_other(capture, protocol):
        return ""
    by_default = protocol == load_protocol()
    advice = "; give its own with --grammar FILE.py" if by_default else ""
    return (
        f"{printable(capture.path)} was recorded with another grammar ({_known(capture)}); decoded "
        f"with {protocol.origin} ({protocol.name} {protocol.version}){advice}"
    )


def _nanoseconds(capture: Capture, key: str) -> int | None:
    try:
        value = float(capture.metadata[key])
    except (KeyError, ValueError):
        return None
    return round(value * MS) if 0 <= value <= _LONGEST else None


TEXT_BATCH = 1 << 14
"""Bytes of the line to decode at once where rows are made of them: those take 300 times as much."""

BATCH_BYTES = 1 << 18
_BYTES_A_READ = 2

WHOLE = Window()

Progress = Callable[[int], object]
"""Gets how many bytes of the line were read more; what it raises ends the work."""


def unheard(size: int) -> None:
    """Hear of a progress that nobody is to be shown."""


class Opened(NamedTuple):
    """A capture, and a decoder that stands at its beginning or at a checkpoint.

    `after` is the checkpoint that the decoder has gone on from, None at the beginning.
    """

    capture: Capture
    decoder: StreamDecoder
    after: StoredCheckpoint | None = None

    def recorded(self, protocol: Protocol) -> Iterator[Recorded]:
        """All that was recorded from there on and not decoded from the bytes."""
        return self.capture.recorded(self.after, look_class(protocol.state_type))

    def decoded(
        self, progress: Progress = unheard, window: Window = WHOLE, largest: int = BATCH_BYTES
    ) -> Iterator[Batch]:
        """Yield all that is decoded from there on, also outside the window; see `event_batches`."""
        for batch in event_batches(self.capture.batches(self.after), progress, window, largest):
            yield from self.decoder.decode(batch)
        yield from self.decoder.finish()


def opened_whole(capture: Capture, protocol: Protocol, timeout: int | None = None) -> Opened:
    """Prepare to decode all of a capture; `timeout` is as in `capture_timeout`."""
    return Opened(capture, capture_decoder(capture, protocol, timeout))


def opened_at(
    capture: Capture, protocol: Protocol, start: int, timeout: int | None = None
) -> Opened:
    """Prepare to decode what comes from `start` (ns since the capture's start) on.

    Only a capture that was opened by its index has checkpoints to go on from; without a fitting
    one it is opened again, as a whole. `timeout` is as in `capture_timeout`. A checkpoint that does
    not fit this protocol or these settings is not used. Raises CaptureError as `open_capture` does.
    """
    if not capture.indexed:
        return opened_whole(capture, protocol, timeout)
    stored = capture.checkpoint_before(start, protocol.sha256)
    state = checkpoint.decoded(stored.value.decoder, protocol) if stored else None
    if stored and state and state.time <= stored.value.t:
        decoder = capture_decoder(capture, protocol, timeout)
        with suppress(ValueError):  # it was saved with other settings
            decoder.resume(state)
            return Opened(capture, decoder, stored)
    from bilprov.captures.reader import open_capture

    return opened_whole(open_capture(capture.path), protocol, timeout)


def event_batches(
    events: Iterable[Events],
    progress: Progress,
    window: Window = WHOLE,
    largest: int = BATCH_BYTES,
) -> Iterator[Events]:
    """Yield those events of a capture that decoding a window needs, about `largest` bytes at once.

    Raises CaptureError as `Capture.batches` does.
    """
    most = min(1 << 10, largest)  # so that there is soon something to show
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


def capture_totals(
    capture: Capture,
    protocol: Protocol,
    progress: Progress = unheard,
    test: Filter | None = None,
) -> Totals:
    """Decode a capture as `replay` does, and count what passes the filter.

    `progress` is given the number of bytes of each batch. Raises CaptureError as `Capture.events`.
    """
    from bilprov.analyzer.totals.totals import Totals

    totals = Totals(protocol)
    for batch in opened_whole(capture, protocol).decoded(progress):
        totals.add(batch, None if test is None else test.selection(batch))
    return totals
