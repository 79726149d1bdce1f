"""Writes the frames that a filter selects, each with its answer, and what decoding needs between.

It follows two decoders: that of the whole recording, by its steps, and the one that will read the
part. As long as nothing is left out the two are in step. Before the next thing that is kept, the
second is put in the state of the first: by a gap, and a checkpoint with that state.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from msgspec.structs import replace

from bilprov.analyzer.decode.anomalies import UNCLEAR
from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    is_frame,
)
from bilprov.analyzer.edit.new_capture import write_resumption
from bilprov.analyzer.edit.steps import Step
from bilprov.analyzer.replay.recorder import RecordWriter
from bilprov.captures.schemas import Chunk, Line, Resumption
from bilprov.captures.topics import Written
from bilprov.spec.protocol import Protocol


@dataclass(slots=True)
class _Kept:
    """An instruction with its answer, or whatever else is kept or left out as one.

    `open` tells that an answer may still come, which may be the reason to keep it.
    """

    keep: bool = False
    open: bool = False


@dataclass(slots=True)
class _Entry:
    """A step that is not written yet: what its byte belongs to, and what its records belong to."""

    step: Step
    owner: _Kept | None = None
    told: list[_Kept] = field(default_factory=list)

    @property
    def hunt_kept(self) -> bool:
        """Whether it is of a hunt that is kept as a whole."""
        return self.step.hunt is not None and self.step.hunt.keep

    @property
    def wanted(self) -> bool:
        """Whether its byte is kept, once that is decided."""
        assert self.owner is not None
        return self.hunt_kept or self.owner.keep

    @property
    def undecided(self) -> bool:
        """Whether it is not known yet if it is kept."""
        if self.step.event is not None and self.owner is None:
            return True
        return any(one.open for one in (self.owner, *self.told) if one)


class Selection:
    """Takes the steps of a recording in order and writes those that belong to selected frames.

    `test` tells whether a record is selected, `counts` whether a byte at a time (ns) is missed if
    it is left out, `paired` whether answers are paired. `frames` counts the frames that are kept.
    Raises CaptureError if the file cannot be written.
    """

    def __init__(
        self,
        protocol: Protocol,
        out: RecordWriter,
        test: Callable[[Record], bool],
        counts: Callable[[int], bool],
        *,
        paired: bool,
    ) -> None:
        self.frames = 0
        self._protocol = protocol
        self._out = out
        self._test = test
        self._counts = counts
        self._paired = paired
        self._entries: deque[_Entry | tuple[Written, int]] = deque()
        # Bytes and line events that no record has told yet, and open instructions.
        self._untold: dict[str, deque[_Entry]] = {"host": deque(), "device": deque(), "": deque()}
        self._waiting: dict[int, _Kept] = {}
        self._before: dict[str, int] = {}  # bytes that the next records have from before the steps
        self._fresh = True  # whether the next step does not follow the last one
        self._in_step = False
        # Whether the part ends in an open frame, with a held answer, or before a moment that is
        # kept and which nothing that is written comes to.
        self._under_way = False
        self._awaited = False  # whether such a moment is the last thing that is kept
        self._now: int | None = None  # how far the part's decoder has come (ns)
        self._left_out = 0  # bytes since the last one that was written
        self._chunk: Chunk | None = None  # what is written next, as more bytes of it may follow
        # Whether the last answers were written: at least those that the next step's state holds.
        self._answers: deque[bool] = deque()

    def step(self, step: Step) -> None:
        """Take the next step."""
        if self._fresh:
            self._before = {"host": len(step.state.frame), "device": len(step.state.held)}
            self._fresh = False
        event = step.event
        if event is None and not step.records and not step.hunt:
            return
        entry = _Entry(step)
        self._entries.append(entry)
        if isinstance(event, Resumption):
            entry.owner = _Kept()
            self._forget()
            self._fresh = True
        elif isinstance(event, Line):
            self._untold[""].append(entry)
        elif event and event.data:
            self._untold[event.direction].append(entry)
        elif event:
            entry.owner = _Kept()
        for record in step.records:
            entry.told.append(self._exchange(record))
        _keep_together(step, entry.told)
        self._write_decided()

    def value(self, value: Written, t: int) -> None:
        """Take a value that is no event (a look of a conformance run), which is kept."""
        self._entries.append((value, t))
        self._write_decided()

    def passed(self, state: DecoderState, size: int = 0) -> None:
        """Nothing is selected up to the next step; so many bytes before it are missed.

        `state` is that after the last step.
        """
        self._forget()
        self._write_decided()
        self._fresh = True
        self._answers.clear()
        self._fall_behind(state)
        self._left_out += size

    def close(self, state: DecoderState, end: int) -> None:
        """End the part of a recording that goes on to `end` (ns) and is in that state there."""
        self._forget()
        self._write_decided()
        self._write_chunk()
        if not self._in_step and (self._left_out or self._under_way or self._now is None):
            # What is under way there would be told as if the recording had ended.
            quiet = replace(
                state,
                time=min(state.time, end),
                frame=b"",
                frame_start=0,
                frame_end=0,
                waiting=(),
                held=(),
                out_of_step=None,
                lost_at=None,
                unsynced_since=None,
            )
            self._resume(quiet, end)

    def _exchange(self, record: Record) -> _Kept:
        """What a record belongs to, with the bytes that it has."""
        exchange = self._belongs(record)
        exchange.keep = exchange.keep or self._test(record)
        if isinstance(record, HostRecord):
            self._own("host", len(record.data), exchange)
        elif isinstance(record, DeviceRecord):
            self._own("device", 1, exchange)
        elif isinstance(record, LineRecord):
            self._own("", 1, exchange)
            if record.lost:
                self._give_up()
        return exchange

    def _belongs(self, record: Record) -> _Kept:
        if isinstance(record, HostRecord):
            exchange = _Kept(open=self._paired and record.sequence is not None)
            if exchange.open and record.sequence is not None:
                self._waiting[record.sequence] = exchange
            return exchange
        number = None
        if isinstance(record, DeviceRecord):
            number = record.instruction
        elif isinstance(record, FaultRecord):
            number = record.fault.instruction
        if number is None or number not in self._waiting:
            return _Kept()
        exchange = self._waiting.pop(number)
        exchange.open = False
        return exchange

    def _own(self, side: str, count: int, exchange: _Kept) -> None:
        before = min(count, self._before.get(side, 0))
        if before:
            self._before[side] -= before
        for _ in range(count - before):
            if self._untold[side]:  # a line event that a Resumption stands for has no entry
                entry = self._untold[side].popleft()
                entry.owner = exchange
                # A frame that begins in a hunt and goes on behind it.
                exchange.keep = exchange.keep or entry.hunt_kept

    def _give_up(self) -> None:
        """No answer will come for the instructions that wait."""
        for exchange in self._waiting.values():
            exchange.open = False
        self._waiting.clear()

    def _forget(self) -> None:
        """What no record has told will not be told."""
        self._give_up()
        for entries in self._untold.values():
            for entry in entries:
                entry.owner = _Kept()
            entries.clear()

    def _write_decided(self) -> None:
        entries = self._entries
        while entries:
            first = entries[0]
            if isinstance(first, _Entry):
                if first.undecided:
                    return
                self._write(first)
                self._note_answer(first)
            else:
                self._write_chunk()
                self._out.write(*first)
            entries.popleft()

    def _write(self, entry: _Entry) -> None:
        step, told = entry.step, entry.told
        if step.apart:
            self._fall_behind(step.state)
        if step.event is None:
            self._write_moment(step, entry.hunt_kept or any(one.keep for one in told), bool(told))
            return
        wanted = entry.wanted
        if isinstance(step.event, Resumption):
            self._answers.clear()
            self._fall_behind(step.state)
            return
        if isinstance(step.event, Line):
            wanted = wanted or any(one.keep for one in told)
            if not wanted and not any(record.faults for record in step.records):
                if self._in_step:
                    self._write_event(step)
                return
        if not wanted:
            self._fall_behind(step.state)
            if isinstance(step.event, Chunk) and self._counts(step.t):
                self._left_out += len(step.event.data)
            return
        self.frames += sum(is_frame(record) for record in step.records)
        passed_over = _passed_over(entry)
        if passed_over or not self._in_step:
            self._resume(self._without(step.state, passed_over), step.t)
        self._write_event(step)

    def _note_answer(self, entry: _Entry) -> None:
        """Note whether an answer was written, as a later state may hold it."""
        step = entry.step
        if isinstance(step.event, Chunk) and step.event.direction == "device" and step.event.data:
            while len(self._answers) > len(step.state.held):
                self._answers.popleft()
            self._answers.append(entry.wanted)

    def _without(self, state: DecoderState, count: int) -> DecoderState:
        """A state in which the first instructions, so many, wait no more.

        Nor does it hold an answer that is left out, which would be told without its byte.
        """
        known = list(self._answers)[-len(state.held) :] if state.held else []
        written = [True] * (len(state.held) - len(known)) + known
        held = tuple(answer for answer, one in zip(state.held, written, strict=True) if one)
        waiting = list(state.waiting)
        for _ in range(count):
            first = waiting.pop(0)
            rest = b"".join(list(first.split(self._protocol))[1:])
            if rest:
                waiting.insert(0, replace(first, frames=rest))
        kept = replace(state, waiting=tuple(waiting), held=held)
        if kept.out_of_step is not None and not kept.may_be_out_of_step:
            kept = replace(kept, out_of_step=None)  # the answer that showed it is left out
        return kept

    def _write_moment(self, step: Step, wanted: bool, tells: bool) -> None:
        """Nothing is written of a moment, but the part's decoder may have to come to it."""
        if wanted:
            if not self._in_step:
                self._resume(self._without(step.state, 0), step.t)
            self.frames += sum(is_frame(record) for record in step.records)
            self._now, self._awaited = step.t, True
        elif tells:
            self._fall_behind(step.state)

    def _fall_behind(self, state: DecoderState) -> None:
        """What comes next does not come to the part's decoder, which stays in this state."""
        if self._in_step:
            self._in_step = False
            self._under_way = bool(state.frame or state.held) or self._awaited

    def _write_event(self, step: Step) -> None:
        event = step.event
        self._now, self._awaited = step.t, False
        if not isinstance(event, Chunk):
            assert event is not None
            self._write_chunk()
            self._out.event(event)
        elif self._chunk is not None and not step.begins:
            self._chunk = replace(self._chunk, data=self._chunk.data + event.data)
        else:
            self._write_chunk()
            self._chunk = event

    def _write_chunk(self) -> None:
        if self._chunk is not None:
            self._out.event(self._chunk)
        self._chunk = None

    def _resume(self, state: DecoderState, t: int) -> None:
        """Bring the part's decoder, which has come to `now`, into a state at `t` (ns)."""
        self._write_chunk()
        gap = None
        if self._left_out or self._now is not None:
            begin = min(t, state.time) if self._now is None else self._now
            gap = Line(begin, "gap", "", _said_of(self._left_out))
        write_resumption(self._out, self._protocol, state, t, gap)
        self._in_step, self._left_out = True, 0
        self._now, self._awaited = t, False


def _passed_over(entry: _Entry) -> int:
    """How many instructions that are left out a byte shows to be unanswered, as it answers one.

    A decoder of the part that waited for them would say so too.
    """
    told = zip(entry.step.records, entry.told, strict=True)
    return sum(isinstance(record, FaultRecord) and not one.keep for record, one in told)


def _said_of(size: int) -> str:
    """The reason for a gap where so many bytes are left out."""
    if not size:
        return "no bytes, but what belongs to others, left out here by bilprov capture cut"
    return f"{size} {'byte' if size == 1 else 'bytes'} left out here by bilprov capture cut"


def _keep_together(step: Step, told: list[_Kept]) -> None:
    """Keep what a step tells if something is kept that cannot be told without it."""
    pairs = list(zip(step.records, told, strict=True))
    hunt = step.hunt
    if hunt and any(
        one.keep and isinstance(record, HostRecord) and record.note == UNCLEAR
        for record, one in pairs
    ):
        hunt.keep = True
    together: list[_Kept] = []
    if isinstance(step.event, Line) or (hunt and hunt.keep):
        together = told
    elif step.event is None:
        together = [one for record, one in pairs if is_frame(record)]
    if (hunt and hunt.keep) or any(one.keep for one in together):
        for one in together:
            one.keep = True
