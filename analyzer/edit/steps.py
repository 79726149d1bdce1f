"""Decodes events step by step: what each byte completes, and from which state to decode it anew.

It is for where a recording is taken apart. Where much is decoded as a whole, use a StreamDecoder.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from msgspec.structs import replace

from bilprov.analyzer.decode import anomalies
from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.records import HostRecord, Record
from bilprov.analyzer.decode.session import Session, SessionSettings
from bilprov.captures.schemas import Chunk, Line, Resumption
from bilprov.spec.protocol import Protocol

Event = Chunk | Line


@dataclass(slots=True)
class Hunt:
    """Events in which frame boundaries were looked for, and bytes before the first one found.

    Those bytes are seen to belong to no frame only together with all that came in the hunt.
    """

    keep: bool = False


@dataclass(frozen=True, slots=True)
class Step:
    """One step of decoding: one byte, a line event, or a moment (`event` is None).

    `t` is when it happens (ns), which is later than the event's own time if that is earlier than
    the one before it. `records` are what it completes. A Session that goes on from `state`
    completes the same with this event and those after it, unless it is one of the bytes of a `hunt`
    before the first frame: from there on boundaries are looked for with fewer bytes.

    `begins` tells whether a byte is the first of its chunk. `apart` tells that the steps before
    this one lead to another state than `state`, in which frame boundaries are still looked for.
    """

    t: int
    event: Event | None
    state: DecoderState
    records: list[Record]
    begins: bool = True
    apart: bool = False
    hunt: Hunt | None = None


@dataclass(slots=True)
class Stepper:
    """Decodes by one Session, whose settings are given, from a state on.

    Steps in which frame boundaries are looked for come when those are found, decoded from there.
    """

    protocol: Protocol
    settings: SessionSettings
    start: DecoderState
    _session: Session = field(init=False)
    _before: DecoderState = field(init=False)  # the state before the hunt that is going on
    _hunted: list[tuple[int, Event, bool]] = field(default_factory=list)
    _found: list[Record] = field(default_factory=list)
    _now: int = 0

    def __post_init__(self) -> None:
        self._session = self._resumed(self.start)
        self._before = self.start
        self._now = self.start.time

    @property
    def state(self) -> DecoderState | None:
        """The state after all that was fed; None while frame boundaries are looked for."""
        return self._session.saved()

    def feed(self, event: Event) -> Iterator[Step]:
        """Yield the steps that an event makes, and the moments before it."""
        self._now = max(self._now, event.t)
        if isinstance(event, Resumption):
            yield from self._resumption(event)
            return
        yield from self._moments(self._now)
        if isinstance(event, Chunk) and len(event.data) > 1:
            for at in range(len(event.data)):
                byte = Chunk(event.t, event.direction, event.data[at : at + 1])
                yield from self._piece(byte, begins=at == 0)
        else:
            yield from self._piece(event, begins=True)

    def finish(self) -> Iterator[Step]:
        """Yield the last steps, at the end of the recording."""
        yield from self._moments(self._now)
        state = self._session.saved()
        records = self._session.finish()
        if state is None:
            self._found += records
            yield from self._settled(self._now, ended=True)
        else:
            yield Step(self._now, None, state, records)

    def _piece(self, event: Event, *, begins: bool) -> Iterator[Step]:
        state = self._session.saved()
        if state is not None and not _begins_a_hunt(event, state):
            yield Step(self._now, event, state, self._session.feed(event), begins)
            return
        self._before = state or self._before
        self._hunted.append((self._now, event, begins))
        self._found += self._session.feed(event)
        if self._session.saved() is not None:
            yield from self._settled(self._now)

    def _moments(self, until: int) -> Iterator[Step]:
        """Let time pass, and yield a step for each moment at which something falls due."""
        session = self._session
        while (due := session.deadline) is not None and due <= until:
            state = session.saved()
            records = session.advance(due)
            if state is not None:
                yield Step(due, None, state, records)
                continue
            self._found += records
            if session.saved() is not None:
                yield from self._settled(due)

    def _resumption(self, event: Resumption) -> Iterator[Step]:
        yield from self._moments(self._now)
        before = self._session.saved() or self._before
        records = self._session.feed(event)
        self._hunted, self._found = [], []  # a Session drops them too
        yield Step(self._now, event, before, records)

    def _settled(self, now: int, *, ended: bool = False) -> Iterator[Step]:
        """Decode the events of a hunt again, with the boundary known, up to `now`."""
        hunted, found = self._hunted, self._found
        self._hunted, self._found = [], []
        garbage = next((record for record in found if _is_unclear(record)), None)
        left = len(garbage.data) if isinstance(garbage, HostRecord) else 0
        hunt = Hunt() if garbage else None
        unclear = self._before
        session = self._resumed(replace(unclear, unsynced_since=None, spoken=False))
        apart = True
        for t, event, begins in hunted:
            if left and isinstance(event, Chunk) and event.direction == "host":
                left -= len(event.data)  # a chunk may be empty
                told = [garbage] if garbage and not left else []
                yield Step(t, event, unclear, told, begins, apart, hunt)
                unclear = replace(unclear, time=t, unsynced_since=t, spoken=False)
                apart = False
                continue
            for due, state, records in _dues(session, t):
                yield Step(due, None, state, records, apart=apart, hunt=hunt)
                apart = False
            state = _state(session)
            yield Step(t, event, state, session.feed(event), begins, apart, hunt)
            apart = False
        for due, state, records in _dues(session, now):
            yield Step(due, None, state, records, hunt=hunt)
        state = _state(session)
        yield Step(now, None, state, session.finish() if ended else [], hunt=hunt)

    def _resumed(self, state: DecoderState) -> Session:
        session = Session(self.protocol, **self.settings)
        session.resume(state)
        return session


def _begins_a_hunt(event: Event, state: DecoderState) -> bool:
    return (
        isinstance(event, Chunk)
        and event.direction == "host"
        and bool(event.data)
        and state.unsynced_since is not None
    )


def _is_unclear(record: Record) -> bool:
    return isinstance(record, HostRecord) and record.note == anomalies.UNCLEAR


def _dues(session: Session, until: int) -> Iterator[tuple[int, DecoderState, list[Record]]]:
    """The moments at which something falls due, with the states before and the records."""
    while (due := session.deadline) is not None and due <= until:
        state = _state(session)
        yield due, state, session.advance(due)


def _state(session: Session) -> DecoderState:
    state = session.saved()
    assert state is not None  # the boundary is known, and only the last event may be a loss
    return state
