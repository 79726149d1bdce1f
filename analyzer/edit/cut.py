"""Writes a part of a capture: all that was recorded in a window of time, or what a filter selects.

Times stay those of the recording. The part begins with a checkpoint, so that it is decoded as the
whole is: with the predicted state, the numbers of the instructions and the answers that are due.
An event that is stamped earlier than the one before it counts as coming with that, as in decoding.

Of a window all raw chunks and line events are kept as they are. Where its end cuts through a frame
that goes on behind it, a `gap` is added, so that nothing is taken for a fault of the host.

Of a filter the reads are kept, whole, that came from the beginning of an instruction to its answer,
or until it was known to have ended, where it holds for one of the two. Where reads are left out
stand a `gap`, which says how much, and a checkpoint from which decoding goes on: what is decoded
from the part are these frames, with the same judgements, states and latencies, and the neighbours
that came in the same reads. While frame boundaries are looked for, all reads are kept.

A new capture is complete under its name, or not there at all. What the old one holds is taken in
batches, with the times at which a decoder takes it.
"""

from __future__ import annotations

import re
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate, chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec.structs import replace

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.checkpoint import DecoderState, encoded, encoded_or_none
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, shapes_of
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.files import replaced_whole
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay import capture_decoding as decoding
from bilprov.analyzer.replay import recorder
from bilprov.analyzer.replay.comparison import Exchange, Exchanges
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Recorded, Resumption, look_class
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

BATCH_VALUES = 1 << 12


class Timed(NamedTuple):
    """A recorded value, and when it came as a decoder takes it (ns): never before another one."""

    now: int
    value: Recorded


def timed(values: Iterator[Recorded], now: int) -> Iterator[Timed]:
    """Yield recorded values, the first of which come at `now` (ns) or later, with their times."""
    for value in values:
        now = max(now, value.t)
        yield Timed(now, value)


def batched(values: Iterator[Timed], most: int = BATCH_VALUES) -> Iterator[list[Timed]]:
    """Yield values in lists of at most `most`, with about 32 KiB of raw bytes.

    No more is taken than is handed out: who stops in between can go on with the rest of `values`.
    """
    batch: list[Timed] = []
    size = 0
    for one in values:
        batch.append(one)
        size += len(one.value.data) if isinstance(one.value, Chunk) else 0
        if len(batch) >= most or size >= 1 << 15:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def events_in(batch: list[Timed]) -> list[Chunk | Line]:
    """The chunks and line events of a batch."""
    return [one.value for one in batch if isinstance(one.value, Chunk | Line)]


def size_of(batch: list[Timed]) -> int:
    """How many raw bytes a batch holds."""
    return sum(len(one.value.data) for one in batch if isinstance(one.value, Chunk))


class Copy(recorder.RecordWriter):
    """A new capture while it is written; `raw_bytes` is how many raw bytes were copied into it.

    `progress` is told how many raw bytes were read for it.
    """

    def __init__(
        self,
        path: Path,
        start: int,
        metadata: Mapping[str, str],
        protocol: Protocol,
        progress: decoding.Progress,
    ) -> None:
        super().__init__(path, start, metadata, shapes_of(protocol))
        self.protocol = protocol
        self.progress = progress
        self.raw_bytes = 0
        self._checkpoints = recorder.Checkpoints(protocol.sha256)

    def values(self, values: Iterable[Recorded]) -> None:
        """Write values as they are, but for checkpoints from which decoding need not go on."""
        for value in values:
            if isinstance(value, Chunk | Line):
                self.event(value)
            elif not isinstance(value, Checkpoint):
                self.write(value, value.t)

    def take(self, batch: list[Timed], decoder: StreamDecoder, *, decoded: bool = False) -> None:
        """Write a batch, and a checkpoint of the decoder that follows it, if one is due.

        With `decoded` what the batch completes is written too.
        """
        self.values(one.value for one in batch)
        batches = decoder.feed(events_in(batch))
        if decoded:
            self.records(batches)
        size = size_of(batch)
        self.raw_bytes += size
        now = batch[-1].now
        made = self._checkpoints.made(now, self.raw_bytes, lambda: encoded_or_none(decoder.saved()))
        if made:
            self.write(made, now)
        self.progress(size)

    def records(self, batches: Iterable[Batch]) -> None:
        """Write all records of decoded batches."""
        for batch in batches:
            for record in batch.records():
                self.record(record)

    def resumption(self, state: DecoderState, t: int, gap: Line | None = None) -> None:
        """Write a checkpoint at `t` (ns) from which decoding is to go on; a `gap` goes before it.

        A state whose text is too long for a message, which no car's traffic leads to, is left out:
        then decoding looks for frame boundaries after the gap.
        """
        text = encoded(state)
        fits = len(text) <= recorder.CHECKPOINT_STATE
        if gap or not fits:
            self.event(gap or Line(t, "gap"))
        if fits:
            self.write(Checkpoint.of(t, self.protocol.sha256, text, resumes=True), t)


def first_state(decoder: StreamDecoder) -> DecoderState:
    """The state of a decoder that was fed nothing since it was opened."""
    state = decoder.saved()
    assert state is not None  # boundaries are looked for only from a byte on
    return state


@contextmanager
def new_capture(
    out: Path,
    captures: Sequence[Capture],
    metadata: Mapping[str, str],
    protocol: Protocol,
    progress: decoding.Progress,
    *,
    force: bool,
) -> Iterator[Copy]:
    """Give a new capture, which is finished and gets its name when the block ends.

    It has the attachments of the `captures`; its time 0 is that of the one that begins first. If
    the block raises, nothing is left of it. Raises CaptureError where it cannot be written.
    """
    start = min(capture.start for capture in captures)
    copy: Copy | None = None
    try:
        with (
            replaced_whole(out, force=force) as part,
            Copy(part, start, metadata, protocol, progress) as copy,
        ):
            for file in chain.from_iterable(one.attachments() for one in captures):
                copy.attach(file.name, file.media_type, file.data, file.log_time - start)
            yield copy
    except ValueError as error:
        raise CaptureError(f"{printable(out)} cannot be written: {error}") from error
    except CaptureError as error:
        cause = error.__cause__
        if not isinstance(cause, OSError) or not (copy is None or copy.failure):
            raise  # the capture that is read
        why = cause.strerror
        raise CaptureError(
            f"{printable(out)} cannot be written ({printable(why)}): make room or name another file"
        ) from error


def decoded_metadata(capture: Capture, protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture for a copy whose records are those of this grammar."""
    about = dict(capture.contents.metadata)
    about.pop(topics.START_KEY, None)
    return about | recorder.grammar_metadata(protocol)


def edited_metadata(capture: Capture, protocol: Protocol, edit: str) -> dict[str, str]:
    """The metadata of a capture for an edited copy, with a word about the edit.

    The settings of its decoding and the grammar are said, so that they do not depend on what is
    left of it.
    """
    about = decoded_metadata(capture, protocol)
    about.pop(topics.PART, None)
    about |= recorder.decoding_metadata(decoding.capture_settings(capture, protocol))
    done = f"{edit} (bilprov {kit_version()})"
    before = about.get(topics.HISTORY)
    about[topics.HISTORY] = f"{before}; {done}" if before else done
    return about


def cut_metadata(
    capture: Capture, protocol: Protocol, window: Window, expression: str | None
) -> dict[str, str]:
    """The metadata of a part: what a filter selects in a window of a capture."""
    words = [f"cut {said_of(capture.path)}"]
    cut: dict[str, str] = {}
    if window.first is not None:
        words.append(f"--start {window.first / 1e9:g}")
        # The decoders that cannot use the checkpoint are attached.
        cut |= {topics.CUT_START: str(window.first), "attached": "yes"}
    if window.after is not None:
        words.append(f"--end {window.after / 1e9:g}")
        cut[topics.CUT_END] = str(window.after)
    if expression:
        words.append(f"--filter {printable(expression)}")
    return edited_metadata(capture, protocol, " ".join(words)) | cut


def said_of(name: Path) -> str:
    """A file's name as it stands in a history: without its folder, safe to show."""
    return re.sub(r"\s+", " ", printable(name.name))


def split_metadata(capture: Capture, protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture of one wire for a copy in which the directions are told apart."""
    about = edited_metadata(capture, protocol, f"both directions of {said_of(capture.path)}")
    if "port_host" in about:
        about["port_wire"] = about.pop("port_host")
    return about | {"heard": " ".join(sorted(BOTH)), "skew_ms": "0"}


def write_split(capture: Capture, copy: Copy) -> None:
    """Write what was recorded by one tap on a wire, each byte with the direction that it has.

    Raises UserError where the capture has the directions already, and CaptureError where it cannot
    be read.
    """
    if decoding.heard(capture) >= BOTH:
        raise UserError(
            f"{printable(capture.path)} has the directions apart already: --half-duplex is for a "
            "capture of one tap"
        )
    protocol = copy.protocol
    wire = HalfDuplex(protocol, decoding.capture_timeout(capture, protocol))
    for value in capture.recorded(looks=look_class(protocol.state_type)):
        if isinstance(value, Chunk):
            copy.progress(len(value.data))
            copy.values(wire.feed(value.data, value.t))
        else:
            copy.values([*wire.rest(), value])
    copy.values(wire.rest())


CUT_THROUGH = "cut here, in the middle of a frame or its answer, which continues after it"


def write_window(
    opened: decoding.Opened, window: Window, copy: Copy, *, decoded: bool = False
) -> None:
    """Write what was recorded in a window.

    `opened` stands at any place before the window. With `decoded` each record that is decoded from
    the bytes is written too, behind the event that completes it. Raises CaptureError as
    `Capture.events` and the writer do.
    """
    protocol = copy.protocol
    decoder = opened.decoder
    values = timed(opened.recorded(protocol), first_state(decoder).time)
    if window.first is not None:
        state, begin = _state_at(decoder, values, window.first, copy.progress)
        values = chain(begin, values)
        decoder = StreamDecoder(protocol, **decoding.capture_settings(opened.capture, protocol))
        decoder.resume(state)
        # A part of a part may begin before that does; then it has a checkpoint already.
        first = begin[0].value if begin else None
        if not (isinstance(first, Resumption) and first.silent):
            copy.resumption(state, min([window.first, *(one.now for one in begin[:1])]))
    behind: list[Timed] = []
    for batch in batched(_before(values, window.after, behind), 1 if decoded else BATCH_VALUES):
        copy.take(batch, decoder, decoded=decoded)
    if decoded:
        copy.records(decoder.finish())
    if behind and window.after is not None:
        decoder.advance(window.after - 1)
        end = decoder.saved()
        soon = end and behind[0].now <= end.time + decoding.AFTERMATH
        if end and soon and (end.frame or end.held):  # which may go on behind the window
            copy.write(Line(end.time, "gap", "", CUT_THROUGH), end.time)


def write_selected(
    opened_at: Callable[[int], decoding.Opened], window: Window, test: Filter, copy: Copy
) -> None:
    """Write the reads of the frames in a window for which a filter holds.

    `opened_at` opens the capture at a place before a time (ns). Its events are read twice: first to
    see when something is selected, and there again. Raises as `write_window` does.
    """
    start = max(0, (window.first or 0) - decoding.AFTERMATH)
    end = None if window.after is None else window.after + decoding.AFTERMATH
    selected = _selected_times(opened_at(start), window, test, copy)
    opened = opened_at(start)
    part = _Part(copy, opened.decoder)
    values = timed(opened.recorded(copy.protocol), first_state(opened.decoder).time)
    for batch in batched(_before(values, end, [])):
        if selected(batch[0].now, batch[-1].now) or part.hunts:
            for one in batch:
                part.take([one], kept=selected(one.now, one.now), counted=window.has(one.now))
        else:
            part.take(batch, kept=False, counted=window.has(batch[-1].now))
        # What is no event, such as the looks of a conformance run, is kept.
        rest = (one.value for one in batch if window.has(one.now))
        copy.values(value for value in rest if not isinstance(value, Chunk | Line))
        copy.progress(size_of(batch))
    part.close()


class _Part:
    """Writes the values of a capture that are kept, and what decoding needs between them.

    The decoder is that of the whole recording.
    """

    def __init__(self, copy: Copy, decoder: StreamDecoder) -> None:
        self._copy = copy
        self._decoder = decoder
        self._known = first_state(decoder)  # the last state in which boundaries were known
        self._since: list[Timed] = []  # what came since then
        self._left_out = 0  # bytes since the last one that was kept
        self._now: int | None = None  # up to when (ns) the part is decoded as the whole is
        self._in_step = False

    def take(self, batch: list[Timed], *, kept: bool, counted: bool) -> None:
        """Take the next values, which are all kept or all left out.

        Bytes that are left out are `counted` if they are missed.
        """
        kept = kept or self.hunts
        if kept and not self._in_step:
            begin = self._since[0].now if self._since else batch[0].now
            self._resume(self._known, begin)
            self._write(self._since)
        elif not kept and self._in_step:
            self._now = batch[0].now  # what falls due before this one still does
        self._in_step = kept
        if kept:
            self._write(batch)
        elif counted:
            self._left_out += size_of(batch)
        self._decoder.feed(events_in(batch))
        state = self._decoder.saved()
        if state is None:
            self._since += batch
        else:
            self._known, self._since = state, []

    @property
    def hunts(self) -> bool:
        """Whether frame boundaries are looked for in what is kept: then all of it is needed."""
        return self._in_step and bool(self._since)

    def close(self) -> None:
        """End the part where the recording goes on: nothing is under way there."""
        if self._in_step:
            return
        quiet: dict[str, Any] = dict.fromkeys(("out_of_step", "lost_at", "unsynced_since"))
        quiet |= {"frame": b"", "frame_start": 0, "frame_end": 0, "waiting": (), "held": ()}
        self._resume(replace(self._known, **quiet), max(self._known.time, self._now or 0))

    def _write(self, batch: list[Timed]) -> None:
        self._copy.values(events_in(batch))
        self._copy.raw_bytes += size_of(batch)
        self._now = batch[-1].now if batch else self._now

    def _resume(self, state: DecoderState, t: int) -> None:
        gap = None
        if self._left_out or self._now is not None:
            what = f"{self._left_out} {'byte' if self._left_out == 1 else 'bytes'}"
            said = f"{what} left out here by bilprov capture cut"
            begin = min(t, state.time) if self._now is None else self._now
            gap = Line(begin, "gap", "", said)
        self._copy.resumption(state, t, gap)
        self._left_out = 0


class _Times:
    """Spans of time (ns), in any order until `in_order`, behind which they are asked for."""

    def __init__(self) -> None:
        self._first, self._last = array("q"), array("q")

    def add(self, spans: Iterable[tuple[int, int]]) -> None:
        """Add spans, as few as they make together."""
        for first, last in sorted(spans):
            if self._last and self._first[-1] <= first <= self._last[-1]:
                self._last[-1] = max(self._last[-1], last)
            else:
                self._first.append(first)
                self._last.append(last)

    def in_order(self) -> Callable[[int, int], bool]:
        """What tells whether a span has some of another one, from a first to a last time."""
        order = array("q", sorted(range(len(self._first)), key=self._first.__getitem__))
        first = array("q", (self._first[at] for at in order))
        latest = array("q", accumulate((self._last[at] for at in order), max))

        def meets(begin: int, end: int) -> bool:
            begun = bisect_right(first, end)
            return begun > 0 and latest[begun - 1] >= begin

        return meets


def _spans(exchanges: Iterable[Exchange]) -> Iterator[tuple[int, int]]:
    """From when to when the selected ones went."""
    for one in exchanges:
        if one.selected and one.frame:
            yield one.frame.t, max(one.frame.known, one.until)


def _selected_times(
    opened: decoding.Opened, window: Window, test: Filter, copy: Copy
) -> Callable[[int, int], bool]:
    """Whether something selected came in a span of time, an instruction with its answer.

    An answer may be stamped `skew` before its instruction: it is known only then to have none.
    """
    settings = decoding.capture_settings(opened.capture, copy.protocol)
    times, pairs = _Times(), Exchanges(paired=settings["heard"] >= BOTH)
    for batch in opened.decoded(copy.progress, window, decoding.TEXT_BATCH):
        chosen = batch.in_order(test.selection(batch) & batch.inside(window.first, window.after))
        spans: list[tuple[int, int]] = []
        for record, selected in zip(batch.records(), chosen.tolist(), strict=True):
            pairs.record(record, selected=selected)
            if selected:
                end = record.known if isinstance(record, HostRecord) else record.t
                if isinstance(record, DeviceRecord) and record.instruction is None:
                    end += settings["skew"]
                spans.append((record.t, end))
        times.add([*spans, *_spans(pairs.settled())])
    pairs.give_up()
    times.add(_spans(pairs.rest))
    return times.in_order()


def _before(values: Iterator[Timed], end: int | None, behind: list[Timed]) -> Iterator[Timed]:
    """Yield the values before `end` (ns); the first one behind it is added to `behind`."""
    for one in values:
        if end is not None and one.now >= end:
            behind.append(one)
            return
        yield one


def _state_at(
    decoder: StreamDecoder, values: Iterator[Timed], start: int, progress: decoding.Progress
) -> tuple[DecoderState, list[Timed]]:
    """Decode up to `start` (ns); returns a state there, and those of the values that follow it.

    Where frame boundaries are looked for then, both are those from before that.
    """
    state = first_state(decoder)
    since: list[Timed] = []  # the last known state
    behind: list[Timed] = []
    for batch in batched(_before(values, start, behind)):
        decoder.feed(events_in(batch))
        progress(size_of(batch))
        saved = decoder.saved()
        since = [*since, *batch] if saved is None else []
        state = saved or state
    if not since:
        decoder.advance(start - 1)
        state = decoder.saved() or state
    return state, since + behind
