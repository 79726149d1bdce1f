"""Random traffic of a protocol for Hypothesis: conversations that mostly go well, and oddities.

`ACTS` draws acts, which are the same for every protocol; `played` makes events of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import SKEW, Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge, nearest
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event


class Said(NamedTuple):
    """One frame: which header (of a valid frame, if `good`), and its data."""

    header: int
    data: bytes
    good: bool


class Act(NamedTuple):
    """Something that happens `pause` ns after the act before it.

    `say` sends frames; with a `cut` they come as two chunks, `gap` ns apart. `answer` gives the
    answers that are due, all or the first `count`, changed as `change` says. `noise` is any bytes
    of a side, `line` an event (`word`, tap `side`).
    """

    pause: int
    kind: Literal["say", "answer", "noise", "line"]
    frames: tuple[Said, ...] = ()
    cut: int = 0
    gap: int = 0
    count: int | None = None
    change: Literal["", "lost", "more", "other"] = ""
    side: Literal["host", "device", ""] = ""
    data: bytes = b""
    word: str = ""


# Mostly far from every time-out; the ends of the longest ones are hit exactly.
_SHORT = [0, 0, 1, 1000, MS, 3 * MS]
_LONG = [15, 20, 25, 40, 50, 70, 100, 110, 120, 999, 1000, 1001, 1100, 2500]
_pause = st.sampled_from(_SHORT * 20 + [long * MS for long in _LONG] + [-MS, -30 * MS])
_gap = st.sampled_from(_SHORT * 2 + [15 * MS, 20 * MS - 1, 20 * MS, 25 * MS, 50 * MS, 60 * MS])

_said = st.builds(Said, st.integers(0, 255), st.binary(max_size=6), st.booleans() | st.just(True))
_say = st.builds(
    Act,
    _pause,
    st.just("say"),
    frames=st.lists(_said, min_size=1, max_size=5).map(tuple),
    cut=st.sampled_from([0] * 8 + [1, 2, 3, 5, 9]),
    gap=_gap,
)
_answer = st.builds(
    Act,
    _pause,
    st.just("answer"),
    count=st.sampled_from([None, None, None, 1, 2]),
    change=st.sampled_from([""] * 20 + ["lost", "more", "other"]),
    data=st.binary(min_size=1, max_size=2),
)
_noise = st.builds(
    Act,
    _pause,
    st.just("noise"),
    side=st.sampled_from(["host", "device"]),
    data=st.binary(max_size=5),
)
_line = st.builds(
    Act,
    _pause,
    st.just("line"),
    side=st.sampled_from(["host", "device", ""]),
    word=st.sampled_from(
        ["break", "open", "parity", "modem", "gap", "overrun", "unplugged", "reconnected"]
    ),
)

_act = st.sampled_from(["say", "answer"] * 20 + ["noise", "line"]).flatmap(
    lambda kind: {"say": _say, "answer": _answer, "noise": _noise, "line": _line}[kind]
)
# Left to itself, a list of at most 60 has five on the average.
ACTS = st.lists(_act, max_size=8) | st.lists(_act, min_size=15, max_size=60)
"""What happens on a line, in order."""

BATCHES = st.lists(st.sampled_from([1, 2, 3, 10, 1000]), min_size=1, max_size=5)
"""How many events are decoded at a time, over and over."""

SETTINGS = st.fixed_dictionaries(
    {
        "skew": st.sampled_from([0, SKEW]),
        "attached": st.booleans(),
        "timeout": st.sampled_from([None] * 6 + [0, 1, 5 * MS, 1500 * MS]),
        "heard": st.sampled_from(
            [frozenset({"host", "device"})] * 4 + [frozenset({"host"}), frozenset({"device"})]
        ),
    }
)
"""Settings of a Session or StreamDecoder."""


def played(protocol: Protocol, acts: Iterable[Act]) -> list[Event]:
    """The events of some acts. Answers are those that a conforming device gives to whole frames."""
    valid = [protocol.header_bytes[spec.id, spec.length] for spec in protocol.instructions]
    events: list[Event] = []
    due = bytearray()
    t = 0
    for act in acts:
        t += act.pause
        if act.kind == "line":
            events.append(Line(t, act.word, act.side))
        elif act.kind == "noise" and act.side:
            events.append(Chunk(t, act.side, act.data))
        elif act.kind == "answer":
            count = len(due) if act.count is None else act.count
            data = _changed(bytes(due[:count]), act)
            del due[:count]
            if data:
                events.append(Chunk(t, "device", data))
        else:
            frames = [_frame(protocol, valid, said) for said in act.frames]
            due += bytes(judge(protocol, frame).response.code for frame in frames)
            data = b"".join(frames)
            events.append(Chunk(t, "host", data[: act.cut] or data))
            if data[act.cut :] and act.cut:
                t += act.gap
                events.append(Chunk(t, "host", data[act.cut :]))
    return events


def _frame(protocol: Protocol, valid: Sequence[int], said: Said) -> bytes:
    header = valid[said.header % len(valid)] if said.good else said.header
    length = protocol.lengths[header]
    frame = bytes([header]) + said.data.ljust(length, b"\x21")[:length]
    return nearest(protocol, frame) if said.good and said.header & 1 else frame


def _changed(data: bytes, act: Act) -> bytes:
    if act.change == "lost":
        return data[1:]
    if act.change == "more":
        return data + act.data
    if act.change == "other":
        return act.data[:1] + data[1:]
    return data


def told(
    source: Session | StreamDecoder,
    events: Sequence[Event],
    batches: Sequence[int] = (1,),
    looks: frozenset[int] = frozenset(),
) -> list[Any]:
    """Feed a Session (which gives records) or a StreamDecoder (which gives batches) to the end.

    The events come in batches of these sizes. `looks` are numbers of events right before which
    the time is told.
    """
    given: list[Any] = []
    at = turn = now = 0
    while at < len(events):
        size = batches[turn % len(batches)]
        turn += 1
        stop = min([at + size, *(look for look in looks if at < look)])
        if at in looks:
            now = max(now, events[at].t)
            given += source.advance(now)
        if isinstance(source, Session):
            for event in events[at:stop]:
                given += source.feed(event)
        else:
            given += source.feed(events[at:stop])
        now = max(now, *(event.t for event in events[at:stop]))
        at = stop
    return given + source.finish()


def records_of(batches: Iterable[Batch]) -> list[Record]:
    """The records of all batches in order."""
    return [record for batch in batches for record in batch.records()]
