"""The values that stored messages carry: one by one, or as arrays where nothing is missing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.captures import topics
from bilprov.captures.events import DEVICE, HOST, LINE, Events
from bilprov.captures.schemas import Checkpoint, Line, Look, Recorded, Resumption
from bilprov.captures.storage.blocks import BLOCK_BYTES, BLOCK_MESSAGES, Messages
from bilprov.captures.storage.records import decoded
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import LONGEST, since

Values: TypeAlias = Iterator[Recorded | Events]
"""The values of messages in order; the raw chunks between others are arrays."""

_SIDES = {topics.HOST_RAW: HOST, topics.DEVICE_RAW: DEVICE}
_OTHER = 255  # the code of a message that is neither of a side nor wanted


def recorded_values(
    start: int,
    names: Mapping[int, str],
    blocks: Iterator[Messages],
    wanted: Mapping[str, type],
    as_stored: bool,
) -> Values:
    """Yield the raw chunks among messages, and the values of the topics that are `wanted`.

    `start` is the capture's, `names` are its topics by channel. `wanted` has the class of a topic's
    values. Where they are not wanted `as_stored`, texts and numbers are made safe, and checkpoints
    from which decoding need not go on are left out.
    """
    values = _values(start, names, blocks, wanted)
    gap: Line | None = None
    for value in values if as_stored else map(_safe, values):
        if isinstance(value, Checkpoint) and value.resumes:
            at = gap or Line(value.t, "gap")
            silent = gap is None
            value = Resumption(at.t, at.event, at.tap, at.detail, checkpoint=value, silent=silent)
        elif gap:
            yield gap
        gap = value if type(value) is Line and value.event == "gap" else None
        if not gap and (as_stored or not isinstance(value, Checkpoint)):
            yield value
    if gap:
        yield gap


def one_by_one(values: Values) -> Iterator[Any]:
    """Yield the same values, each chunk by itself."""
    for value in values:
        if isinstance(value, Events):
            yield from value.single()
        else:
            yield value


def batches_of(events: Iterable[Any]) -> Iterator[Events]:
    """Yield the same events as larger arrays."""
    held: list[Events | Line] = []
    rows = size = 0
    for value in events:
        held.append(value)
        rows += len(value) if isinstance(value, Events) else 1
        size += len(value.data) if isinstance(value, Events) else 0
        if rows >= BLOCK_MESSAGES or size >= BLOCK_BYTES:
            yield Events.joined(held)
            held, rows, size = [], 0, 0
    if held:
        yield Events.joined(held)


def _values(
    start: int, names: Mapping[int, str], blocks: Iterator[Messages], wanted: Mapping[str, type]
) -> Values:
    codes = np.full(1 << 16, _OTHER, np.uint8)
    for channel, topic in names.items():
        codes[channel] = _SIDES.get(topic, LINE if topic in wanted else _OTHER)
    for block in blocks:
        if block.lost:
            yield Line(since(start, int(block.log_time[0])), "gap", "", block.lost)
        sides = codes[block.channel]
        raw = np.flatnonzero(sides <= DEVICE)
        t = _times_since(start, block.log_time)
        chunks = Events(t[raw], sides[raw], (block.end - block.start)[raw], block.data(raw))
        others = np.flatnonzero(sides == LINE)
        done = 0
        for row, at in zip(others.tolist(), np.searchsorted(raw, others).tolist(), strict=True):
            if at > done:
                yield chunks.part(done, at)
                done = at
            data = block.content[block.start[row] : block.end[row]]
            value: Any = decoded(data, wanted[names[int(block.channel[row])]])
            if value is not None:
                yield replace(value, t=int(t[row]))
        if done < len(chunks):
            yield chunks.part(done, len(chunks)) if done else chunks


def _safe(value: Recorded | Events) -> Recorded | Events:
    """The value; a line event or a look with texts that print and numbers within 64 bits."""
    if not isinstance(value, Line | Look):
        return value
    changed: dict[str, Any] = {}
    for name in value.__struct_fields__:
        held = getattr(value, name)
        if isinstance(held, str):
            changed[name] = printable(held)
        elif held.__class__ is int:
            changed[name] = min(max(held, -LONGEST), LONGEST)
    return replace(value, **changed)


def _times_since(start: int, log_times: NDArray[np.uint64]) -> NDArray[np.int64]:
    most = (1 << 64) - 1
    limits = np.array([start - LONGEST, start + LONGEST], object).clip(0, most).astype(np.uint64)
    return (log_times.clip(*limits) - np.uint64(start)).view(np.int64)
