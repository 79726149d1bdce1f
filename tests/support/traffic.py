"""Random traffic of a protocol for Hypothesis: conversations that mostly go well, and oddities.

`ACTS` draws seeds, and `played` makes events of one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from random import Random
from typing import Any, NamedTuple

from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import SKEW, Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge, nearest
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event


class Acts(NamedTuple):
    """So many acts of a host, a device and a line, drawn by a seed."""

    seed: int
    count: int


ACTS = st.builds(Acts, st.integers(0, 1 << 32), st.sampled_from([0, 1, 3, 8, 30, 60, 60, 90]))
"""What happens on a line, in order."""

# Half of them far from every time-out; the ends of those are hit exactly.
_SHORT = [0, 0, 1, 1000, MS, 3 * MS]
_LONG = [15, 20, 25, 40, 50, 70, 100, 110, 120, 999, 1000, 1001, 1100, 2500]
_PAUSES = _SHORT * 2 + [long * MS for long in _LONG] + [20 * MS] * 3 + [-MS, -30 * MS]
_GAPS = [*_SHORT * 2, 15 * MS, 20 * MS - 1, 20 * MS, 25 * MS, 50 * MS, 60 * MS]
_WORDS = ("break", "open", "parity", "modem", "gap", "overrun", "unplugged", "reconnected")

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


def played(protocol: Protocol, acts: Acts) -> list[Event]:
    """The events of some acts. Answers are those that a conforming device gives to whole frames."""
    random, events = Random(acts.seed), list[Event]()
    due, t = b"", 0
    for _ in range(acts.count):
        t += random.choice(_PAUSES)
        kind = random.choice(["say", "answer"] * 4 + ["noise", "line"])
        if kind == "line":
            events.append(Line(t, random.choice(_WORDS), random.choice(["host", "device", ""])))
        elif kind == "noise":
            data = random.randbytes(random.randint(0, 5))
            events.append(Chunk(t, random.choice(["host", "device"]), data))
        elif kind == "answer":
            count = random.choice([len(due)] * 3 + [1, 2])
            data, due = _changed(random, due[:count]), due[count:]
            events += [Chunk(t, "device", data)] if data else []
        else:
            frames = [_frame(protocol, random) for _ in range(random.randint(1, 5))]
            due += bytes(judge(protocol, frame).response.code for frame in frames)
            data, cut = b"".join(frames), random.choice([0] * 8 + [1, 2, 3, 5, 9])
            events.append(Chunk(t, "host", data[:cut] or data))
            if cut and data[cut:]:
                t += random.choice(_GAPS)
                events.append(Chunk(t, "host", data[cut:]))
    return events


def _frame(protocol: Protocol, random: Random) -> bytes:
    """A frame of an instruction, mostly, or of any header; its data may be out of range."""
    good = random.random() < 0.75
    spec = random.choice(protocol.instructions)
    header = protocol.header_bytes[spec.id, spec.length] if good else random.randrange(256)
    frame = bytes([header]) + random.randbytes(protocol.lengths[header])
    return nearest(protocol, frame) if good and random.random() < 0.5 else frame


def _changed(random: Random, answers: bytes) -> bytes:
    """The answers, of which one is seldom lost, another one, or one too many."""
    other = random.randbytes(1)
    seldom = [answers[1:], answers + other, other + answers[1:]]
    return random.choice([answers] * 8 + seldom)


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
