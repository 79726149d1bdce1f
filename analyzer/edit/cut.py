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
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from itertools import chain
from typing import TYPE_CHECKING

from msgspec.structs import replace

from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.records import DeviceRecord, FaultRecord, HostRecord, Record
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.edit.new_capture import (
    BATCH_VALUES,
    Timed,
    batched,
    copy_batch,
    events_in,
    first_state,
    size_of,
    timed,
    write_records,
    write_resumption,
)
from bilprov.analyzer.output.outputs import Window
from bilprov.analyzer.replay.capture_decoding import (
    TEXT_BATCH,
    Opened,
    Progress,
    capture_settings,
    decoded,
)
from bilprov.analyzer.replay.playback import AFTERMATH
from bilprov.analyzer.replay.recorder import Checkpoints, RecordWriter
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Resumption
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

CUT_THROUGH = "cut here, in the middle of a frame or its answer, which continues after it"


def write_window(
    opened: Opened,
    protocol: Protocol,
    out: RecordWriter,
    window: Window,
    progress: Progress,
    *,
    decoded: bool = False,
) -> int:
    """Write what was recorded in a window, and return how many raw bytes that is.

    `opened` stands at any place before the window. With `decoded` each record that is decoded from
    the bytes is written too, behind the event that completes it. Raises CaptureError as
    `Capture.events` and the writer do.
    """
    settings = capture_settings(opened.capture, protocol)
    decoder = opened.decoder
    values = timed(opened.recorded(protocol), first_state(decoder).time)
    if window.first is not None:
        state, values = _state_at(decoder, values, window.first, progress)
        decoder = StreamDecoder(protocol, **settings)
        decoder.resume(state)
        begin = next(values, None)
        if begin is not None:
            values = chain([begin], values)
        # A part of a part may begin before that does; then it has a checkpoint already.
        begun = begin and isinstance(begin.value, Resumption) and begin.value.silent
        if not begun:
            at = window.first if begin is None else min(window.first, begin.now)
            write_resumption(out, protocol, state, at)
    kept = 0
    behind: list[Timed] = []
    checkpoints = Checkpoints(protocol.sha256)
    together = 1 if decoded else BATCH_VALUES
    for batch in batched(_before(values, window.after, behind), together):
        kept = copy_batch(out, decoder, checkpoints, batch, kept, decoded=decoded)
        progress(size_of(batch))
    if decoded:
        write_records(out, decoder.finish())
    if behind and window.after is not None:
        decoder.advance(window.after - 1)
        end = decoder.saved()
        soon = end and behind[0].now <= end.time + AFTERMATH
        if end and soon and (end.frame or end.held):  # which may go on behind the window
            out.write(Line(end.time, "gap", "", CUT_THROUGH), end.time)
    return kept


def write_selected(
    opened_at: Callable[[int], Opened],
    protocol: Protocol,
    out: RecordWriter,
    window: Window,
    test: Filter,
    progress: Progress,
) -> int:
    """Write the reads of the frames in a window for which a filter holds; return how many bytes.

    `opened_at` opens the capture at a place before a time (ns). Its events are read twice: first to
    see when something is selected, and there again. Raises as `write_window` does.
    """
    start = max(0, (window.first or 0) - AFTERMATH)
    end = None if window.after is None else window.after + AFTERMATH
    selected = _selected_times(opened_at(start), protocol, window, test, progress)
    opened = opened_at(start)
    part = _Part(protocol, out, opened.decoder)
    values = timed(opened.recorded(protocol), first_state(opened.decoder).time)
    for batch in batched(_before(values, end, [])):
        if selected.meets(batch[0].now, batch[-1].now) or part.hunts:
            for one in batch:
                part.take([one], kept=selected.meets(one.now, one.now), counted=window.has(one.now))
        else:
            part.take(batch, kept=False, counted=window.has(batch[-1].now))
        for one in batch:
            # What is no event, such as the looks of a conformance run, is kept.
            if not isinstance(one.value, Chunk | Line | Checkpoint) and window.has(one.now):
                out.write(one.value, one.value.t)
        progress(size_of(batch))
    part.close()
    return part.size


class _Part:
    """Writes the values of a capture that are kept, and what decoding needs between them.

    `size` is how many raw bytes were kept. The decoder is that of the whole recording.
    """

    def __init__(self, protocol: Protocol, out: RecordWriter, decoder: StreamDecoder) -> None:
        self.size = 0
        self._protocol = protocol
        self._out = out
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
        quiet = replace(
            self._known,
            frame=b"",
            frame_start=0,
            frame_end=0,
            waiting=(),
            held=(),
            out_of_step=None,
            lost_at=None,
            unsynced_since=None,
        )
        self._resume(quiet, max(self._known.time, self._now or 0))

    def _write(self, batch: list[Timed]) -> None:
        for event in events_in(batch):
            self._out.event(event)
        self.size += size_of(batch)
        self._now = batch[-1].now if batch else self._now

    def _resume(self, state: DecoderState, t: int) -> None:
        gap = None
        if self._left_out or self._now is not None:
            what = f"{self._left_out} {'byte' if self._left_out == 1 else 'bytes'}"
            said = f"{what} left out here by bilprov capture cut"
            begin = min(t, state.time) if self._now is None else self._now
            gap = Line(begin, "gap", "", said)
        write_resumption(self._out, self._protocol, state, t, gap)
        self._left_out = 0


class _Times:
    """Spans of time, each of which begins after the one before it has ended."""

    def __init__(self) -> None:
        self._first, self._last = array("q"), array("q")
        self._at = 0

    def add(self, first: int, last: int) -> None:
        """Add a span (ns), which may begin before others that were added earlier."""
        while self._last and first <= self._last[-1]:
            first, last = min(first, self._first.pop()), max(last, self._last.pop())
        self._first.append(first)
        self._last.append(last)

    def meets(self, first: int, last: int) -> bool:
        """Whether a span has some of this one; asked for later and later ones."""
        while self._at < len(self._last) and self._last[self._at] < first:
            self._at += 1
        return self._at < len(self._first) and self._first[self._at] <= last


def _selected_times(
    opened: Opened, protocol: Protocol, window: Window, test: Filter, progress: Progress
) -> _Times:
    """When what is selected came, each instruction with its answer."""
    settings = capture_settings(opened.capture, protocol)
    found = _Exchanges(paired=settings["heard"] >= BOTH, skew=settings["skew"])
    batches = decoded(opened.decoder, opened.batches(), progress, window, TEXT_BATCH)
    for batch in batches:
        chosen = batch.in_order(test.selection(batch) & batch.inside(window.first, window.after))
        for record, selected in zip(batch.records(), chosen.tolist(), strict=True):
            found.add(record, selected)
    found.give_up()
    return found.times


class _Exchanges:
    """Notes when selected instructions and answers came; where answers are `paired`, as one.

    An answer may be stamped `skew` ns before its instruction: it is known only then to have none.
    """

    def __init__(self, *, paired: bool, skew: int) -> None:
        self.times = _Times()
        self._paired = paired
        self._skew = skew
        self._waiting: dict[int, tuple[HostRecord, bool]] = {}

    def add(self, record: Record, selected: bool) -> None:
        """Take the next record."""
        if isinstance(record, HostRecord) and record.sequence is not None and self._paired:
            self._waiting[record.sequence] = record, selected
            return
        number = None
        end = record.t
        if isinstance(record, DeviceRecord):
            number = record.instruction
            end += self._skew * (number is None)
        elif isinstance(record, FaultRecord):
            number = record.fault.instruction
        elif isinstance(record, HostRecord):
            end = record.known
        elif record.lost:
            self.give_up()
        if number is not None and number in self._waiting:
            frame, frame_selected = self._waiting.pop(number)
            self._note(frame.t, max(frame.known, end), selected or frame_selected)
        else:
            self._note(record.t, end, selected)

    def give_up(self) -> None:
        """No answer will come for the instructions that wait."""
        for frame, selected in self._waiting.values():
            self._note(frame.t, frame.known, selected)
        self._waiting.clear()

    def _note(self, first: int, last: int, selected: bool) -> None:
        if selected:
            self.times.add(min(first, last), max(first, last))


def _before(values: Iterator[Timed], end: int | None, behind: list[Timed]) -> Iterator[Timed]:
    """Yield the values before `end` (ns); the first one behind it is added to `behind`."""
    for one in values:
        if end is not None and one.now >= end:
            behind.append(one)
            return
        yield one


def _state_at(
    decoder: StreamDecoder, values: Iterator[Timed], start: int, progress: Progress
) -> tuple[DecoderState, Iterator[Timed]]:
    """Decode up to `start` (ns); returns a state there and the values from it on.

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
    return state, chain(since, behind, values)
