"""Takes what a capture holds in batches, with the times at which a decoder takes it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from bilprov.analyzer.decode.checkpoint import DecoderState, encoded_or_none
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.replay.recorder import Checkpoints, RecordWriter
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Recorded, Resumption

_BATCH_VALUES = 1 << 12
_BATCH_BYTES = 1 << 15


class Timed(NamedTuple):
    """A recorded value, and when it came as a decoder takes it (ns): never before another one."""

    now: int
    value: Recorded


def timed(values: Iterator[Recorded], now: int) -> Iterator[Timed]:
    """Yield recorded values, the first of which come at `now` (ns) or later, with their times."""
    for value in values:
        now = max(now, value.t)
        yield Timed(now, value)


def batched(values: Iterator[Timed]) -> Iterator[list[Timed]]:
    """Yield values in lists of at most 4,096, with about 32 KiB of raw bytes.

    No more is taken than is handed out: who stops in between can go on with the rest of `values`.
    """
    batch: list[Timed] = []
    size = 0
    for one in values:
        batch.append(one)
        size += len(one.value.data) if isinstance(one.value, Chunk) else 0
        if len(batch) >= _BATCH_VALUES or size >= _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def parted(batches: Iterator[list[Timed]]) -> Iterator[list[Timed]]:
    """Yield the batches in such parts that each Resumption is the first of one."""
    for batch in batches:
        begin = 0
        for place, one in enumerate(batch):
            if place > begin and isinstance(one.value, Resumption):
                yield batch[begin:place]
                begin = place
        yield batch[begin:]


def events_in(batch: list[Timed]) -> list[Chunk | Line]:
    """The chunks and line events of a batch."""
    return [one.value for one in batch if isinstance(one.value, Chunk | Line)]


def size_of(batch: list[Timed]) -> int:
    """How many raw bytes a batch holds."""
    return sum(len(one.value.data) for one in batch if isinstance(one.value, Chunk))


def write_values(out: RecordWriter, batch: list[Timed]) -> None:
    """Write a batch as it is, but for checkpoints from which decoding need not go on."""
    for one in batch:
        if isinstance(one.value, Chunk | Line):
            out.event(one.value)
        elif not isinstance(one.value, Checkpoint):
            out.write(one.value, one.value.t)


def copy_batch(
    out: RecordWriter,
    decoder: StreamDecoder,
    checkpoints: Checkpoints,
    batch: list[Timed],
    size: int,
) -> int:
    """Write and decode a batch, and write a checkpoint if one is due.

    `size` raw bytes were copied before; returns how many are now.
    """
    write_values(out, batch)
    decoder.feed(events_in(batch))
    size += size_of(batch)
    made = checkpoints.made(batch[-1].now, size, lambda: encoded_or_none(decoder.saved()))
    if made:
        out.write(made, made.t)
    return size


def first_state(decoder: StreamDecoder) -> DecoderState:
    """The state of a decoder that was fed nothing since it was opened."""
    state = decoder.saved()
    assert state is not None  # boundaries are looked for only from a byte on
    return state
