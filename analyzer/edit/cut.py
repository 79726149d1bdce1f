"""Writes a part of a capture: all that was recorded in a window of time, or what a filter selects.

Times stay those of the recording. The part begins with a checkpoint, so that it is decoded as the
whole is: with the predicted state, the numbers of the instructions and the answers that are due.
An event that is stamped earlier than the one before it counts as coming with that, as in decoding.

Of a window all raw chunks and line events are kept as they are. Where its end cuts through a frame
that goes on behind it, a `gap` is added, so that nothing is taken for a fault of the host.

Of a filter the bytes of the frames are kept for which it holds, each instruction with its answer
and each answer with its instruction. Where something is left out stand a `gap`, which says how
much, and a checkpoint from which decoding goes on. What is decoded from the part are these frames,
with the same judgements, states and latencies. Those that only what came at one moment tells apart
(a frame that was given up, with the answers in its midst) stay together, as do bytes before the
first frame of a recording with the frames by which they are seen to be none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import TYPE_CHECKING

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.session import BOTH, Session, SessionSettings
from bilprov.analyzer.edit.new_capture import write_resumption
from bilprov.analyzer.edit.recorded_values import (
    Timed,
    batched,
    events_in,
    first_state,
    saved_text,
    size_of,
    timed,
    write_values,
)
from bilprov.analyzer.edit.selection import Selection
from bilprov.analyzer.edit.steps import Stepper
from bilprov.analyzer.output.outputs import NoOutput, Shown, Window
from bilprov.analyzer.replay.capture_parts import Progress
from bilprov.analyzer.replay.capture_session import capture_settings
from bilprov.analyzer.replay.playback import AFTERMATH
from bilprov.analyzer.replay.recorder import Checkpoints, RecordWriter
from bilprov.analyzer.replay.seek import Opened
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Resumption
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter

CUT_THROUGH = "cut here, in the middle of a frame or its answer, which continues after it"


def write_window(
    opened: Opened, protocol: Protocol, out: RecordWriter, window: Window, progress: Progress
) -> int:
    """Write what was recorded in a window, and return how many raw bytes that is.

    `opened` stands at any place before the window. Raises CaptureError as `Capture.events` and the
    writer do.
    """
    settings = capture_settings(opened.capture, protocol)
    decoder = opened.decoder
    values = timed(opened.recorded(), first_state(decoder).time)
    if window.first is not None:
        state, values = _state_at(decoder, protocol, settings, values, window.first, progress)
        decoder = StreamDecoder(protocol, **settings)
        decoder.resume(state)
        begin = next(values, None)
        if begin is not None:
            values = chain([begin], values)
        # A part of a part may begin before that does; then it has a checkpoint already.
        begun = begin and isinstance(begin.value, Resumption) and begin.value.silent
        if not begun:
            write_resumption(out, protocol, state, window.first)
    kept = 0
    behind: list[Timed] = []
    checkpoints = Checkpoints(protocol.sha256)
    for batch in batched(_before(values, window.after, behind)):
        write_values(out, batch)
        decoder.feed(events_in(batch))
        kept += size_of(batch)
        made = checkpoints.made(batch[-1].now, kept, lambda: saved_text(decoder))
        if made:
            out.write(made, made.t)
        progress(size_of(batch))
    end = decoder.saved()
    if behind and end and _cuts_through(protocol, settings, end, chain(behind, values)):
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
    """Write the frames in a window for which a filter holds, and return how many there are.

    `opened_at` opens the capture at a place before a time (ns). Its events are read twice: first
    decoded at once, to see where something is selected, and there again step by step. Raises as
    `write_window` does.
    """
    start = max(0, (window.first or 0) - AFTERMATH)
    end = None if window.after is None else window.after + AFTERMATH
    near = _selected_times(opened_at(start), window, test, end, progress)
    opened = opened_at(start)
    settings = capture_settings(opened.capture, protocol)

    def selected(record: Record) -> bool:
        line = json_line(record) if window.has(record.t) else None
        return line is not None and test(line)

    selection = Selection(protocol, out, selected, window.has, paired=settings["heard"] >= BOTH)
    decoder = opened.decoder
    state, now = first_state(decoder), 0
    since: list[Timed] = []  # the last known state, and nothing is selected in them
    stepper: Stepper | None = None
    behind: list[Timed] = []
    values = timed(opened.recorded(), state.time)
    for batch in batched(_before(values, end, behind)):
        now = batch[-1].now
        is_near = near.meets(batch[0].now, now)
        if stepper is None and is_near:
            stepper = Stepper(protocol, settings, state)
            _step(stepper, selection, [one for one in since if _is_event(one)], window)
            since = []
        if stepper is not None:
            _step(stepper, selection, batch, window)
            saved = stepper.state
            if saved is not None and not is_near:
                decoder.resume(saved)
                selection.passed(saved)
                state, stepper = saved, None
        else:
            for one in batch:
                _keep_value(selection, one, window)
            since += batch
            decoder.feed(events_in(batch))
            saved = decoder.saved()
            if saved is not None:
                missed = [one for one in since if window.has(one.now)]
                selection.passed(saved, size_of(missed))
                state, since = saved, []
        progress(size_of(batch))
    if stepper is not None and not behind:
        for step in stepper.finish():
            selection.step(step)
    selection.close((stepper.state if stepper else None) or state, now)
    return selection.frames


def _step(stepper: Stepper, selection: Selection, batch: list[Timed], window: Window) -> None:
    for one in batch:
        if isinstance(one.value, Chunk | Line):
            for step in stepper.feed(one.value):
                selection.step(step)
        _keep_value(selection, one, window)


def _keep_value(selection: Selection, one: Timed, window: Window) -> None:
    """Keep what is no event, such as the looks of a conformance run."""
    if not isinstance(one.value, Chunk | Line | Checkpoint) and window.has(one.now):
        selection.value(one.value, one.value.t)


def _is_event(one: Timed) -> bool:
    return isinstance(one.value, Chunk | Line)


class _Times:
    """Spans of time, each of which begins after the one before it has ended."""

    def __init__(self) -> None:
        self._spans: list[tuple[int, int]] = []
        self._at = 0

    def add(self, first: int, last: int) -> None:
        """Add a span (ns), which ends at the latest where the last one does, or later."""
        if self._spans and first <= self._spans[-1][1]:
            begin, end = self._spans.pop()
            first, last = min(begin, first), max(end, last)
        self._spans.append((first, last))

    def meets(self, first: int, last: int) -> bool:
        """Whether a span has some of this one; asked for later and later ones."""
        while self._at < len(self._spans) and self._spans[self._at][1] < first:
            self._at += 1
        return self._at < len(self._spans) and self._spans[self._at][0] <= last


def _selected_times(
    opened: Opened, window: Window, test: Filter, end: int | None, progress: Progress
) -> _Times:
    """When something is selected, and as long before and after as an answer may take."""
    near = _Times()
    shown = Shown(NoOutput(), test, window=window)
    decoder = opened.decoder
    behind: list[Timed] = []
    for batch in batched(_before(timed(opened.recorded(), 0), end, behind)):
        _note(near, shown, decoder.feed(events_in(batch)))
        progress(size_of(batch))
    if not behind:
        _note(near, shown, decoder.finish())
    return near


def _note(near: _Times, shown: Shown, parts: list[Batch]) -> None:
    times = [record.t for part in parts for record in shown.show(part).records()]
    if times:
        near.add(min(times) - AFTERMATH, max(times) + AFTERMATH)


def _before(values: Iterator[Timed], end: int | None, behind: list[Timed]) -> Iterator[Timed]:
    """Yield the values before `end` (ns); the first one behind it is added to `behind`."""
    for one in values:
        if end is not None and one.now >= end:
            behind.append(one)
            return
        yield one


def _state_at(
    decoder: StreamDecoder,
    protocol: Protocol,
    settings: SessionSettings,
    values: Iterator[Timed],
    start: int,
    progress: Progress,
) -> tuple[DecoderState, Iterator[Timed]]:
    """Decode up to `start` (ns); returns the state there and the values from there on."""
    state = first_state(decoder)
    since: list[Timed] = []  # the last known state
    for batch in batched(values):
        since += batch
        if batch[-1].now >= start:
            break
        decoder.feed(events_in(batch))
        progress(size_of(batch))
        saved = decoder.saved()
        if saved is not None:
            state, since = saved, []
    stepper = Stepper(protocol, settings, state)
    ahead: list[Timed] = []
    near = iter(since)
    for one in chain(near, values):
        if one.now >= start:
            ahead.append(one)
        for step in stepper.feed(one.value) if isinstance(one.value, Chunk | Line) else ():
            state = step.state
            if step.t >= start:
                return state, chain(ahead, near, values)
    return stepper.state or state, iter(ahead)


def _cuts_through(
    protocol: Protocol, settings: SessionSettings, end: DecoderState, behind: Iterator[Timed]
) -> bool:
    """Whether a recording that ends in a state tells other frames than it does with what follows.

    Frames that began before the end are compared, not those of which every byte comes behind it.
    """
    if not end.frame and not end.held:
        return False
    ended, going_on = (Session(protocol, **settings) for _ in range(2))
    for session in (ended, going_on):
        session.resume(end)
    here = [_seen(record) for record in ended.finish() if _is_frame_before(record, end)]
    there: list[object] = []
    for one in behind:
        if one.now > end.time + AFTERMATH or len(there) >= len(here):
            break
        if isinstance(one.value, Chunk | Line):
            records = going_on.feed(one.value)
            there += [_seen(record) for record in records if _is_frame_before(record, end)]
    if len(there) < len(here):
        records = going_on.finish()
        there += [_seen(record) for record in records if _is_frame_before(record, end)]
    return here != there[: len(here)]


def _is_frame_before(record: Record, end: DecoderState) -> bool:
    """Whether a frame is one that was open or held at the end."""
    if isinstance(record, HostRecord):
        return bool(end.frame) and record.t == end.frame_start
    return isinstance(record, DeviceRecord) and (record.t, record.byte) in end.held


def _seen(record: Record) -> object:
    if isinstance(record, HostRecord):
        return record.kind, record.data
    assert isinstance(record, DeviceRecord)
    return record.byte, record.instruction
