"""Opens a finished capture by its index, and reads it from a checkpoint on.

Nothing before the checkpoint is read, so that it takes no longer in a large file.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from io import BufferedReader
from pathlib import Path

import msgspec

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.events import Events
from bilprov.captures.parts import kept_parts, merged, volumes_of
from bilprov.captures.reader import (
    Capture,
    Recorded,
    batches_of,
    capture_of,
    events_of,
    first_expected,
    in_one,
    read_volume,
    recorded_of,
    sights_of,
)
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Look
from bilprov.captures.storage import records
from bilprov.captures.storage.blocks import Stored
from bilprov.captures.storage.index import Index, IndexedChunk, read_index
from bilprov.captures.storage.messages import Contents, Order, Part, Place, parts_after, single
from bilprov.captures.storage.records import MAGIC, Damaged
from bilprov.captures.storage.recovery import RecordFile
from bilprov.captures.storage.survey import JSON_ERRORS

_CHECKPOINTS = topics.BY_VALUE[Checkpoint].channel


@dataclass(frozen=True, slots=True)
class StoredCheckpoint:
    """A checkpoint of a file, and the place of its message: what stands behind it comes after.

    `volume` tells in which of the capture's volumes, counted from 0.
    """

    value: Checkpoint
    place: Place = field(repr=False)
    volume: int = field(repr=False)


@dataclass(frozen=True, slots=True)
class IndexedCapture(Capture):
    """A finished capture of bilprov that was opened by its index; its data were not walked.

    It reads as other captures do. `damage` is empty because nobody looked: where a part turns out
    to be damaged, it is left out and a Line `gap` is inserted, as after a survey. `contents.sizes`
    is empty. `indexes` are those of its volumes.
    """

    indexes: tuple[Index, ...] = field(repr=False)

    def checkpoint_before(self, t: int, grammar: str | None = None) -> StoredCheckpoint | None:
        """The last checkpoint with a time below `t` (ns since the capture's start), None without.

        With `grammar`, its decoder's grammar has that sha256. A checkpoint that is damaged, or is
        not what it says it is, is passed over for the one before it. Raises CaptureError if the
        file changed since it was opened or cannot be read.
        """
        recorded = self.metadata.get("grammar_sha256")
        if not self.contents.counts.get(topics.CHECKPOINT) or (
            grammar and recorded and recorded != grammar
        ):
            return None

        for number in reversed(range(len(self.volumes))):
            read = partial(self._checkpoints_before, t, number)
            for found in read_volume(self.volumes[number], read):
                value = found.value
                if value.t < t and value.whole and grammar in (None, value.grammar):
                    return found
        return None

    def _checkpoints_before(
        self, t: int, number: int, file: BufferedReader, contents: Contents
    ) -> Iterator[StoredCheckpoint]:
        _check_size(file.fileno(), contents.size)
        source = RecordFile(file, contents.size)
        source.own = True
        for chunk in self.indexes[number].chunks_before(self.start + t, _CHECKPOINTS):
            for value, place in _checkpoints(source, chunk, self.start):
                yield StoredCheckpoint(value, place, number)

    def events(self, after: StoredCheckpoint | None = None) -> Iterator[Chunk | Line]:
        """Yield the chunks and line events in order; those behind a checkpoint if one is given.

        Raises CaptureError if the file changed since it was opened or cannot be read.
        """
        return events_of(self, self._stored(after))

    def batches(self, after: StoredCheckpoint | None = None) -> Iterator[Events]:
        """Yield the same as `events(after)` as arrays."""
        return batches_of(self, self._parts(after))

    def sights(self, after: StoredCheckpoint | None = None) -> Iterator[Chunk | Line | Look]:
        """Yield the events and the looks of a conformance run, as `events` does."""
        return sights_of(self, self._stored(after))

    def recorded(self, after: StoredCheckpoint | None = None) -> Iterator[Recorded]:
        """Yield all that was recorded and not decoded from the bytes, as `events` does."""
        return recorded_of(self, self._stored(after))

    def _stored(self, after: StoredCheckpoint | None = None) -> Iterator[Stored]:
        return single(self._parts(after))

    def _parts(self, after: StoredCheckpoint | None = None) -> Iterator[Part]:
        order = Order(first_expected(self))
        first = after.volume if after else 0

        def read(place: Place | None, file: BufferedReader, contents: Contents) -> Iterator[Part]:
            _check_size(file.fileno(), contents.size)
            yield from parts_after(file, contents, order, place)
            _check_size(file.fileno(), contents.size)

        volumes = list(self.volumes[first:])
        if after:  # what is missing before its part is no loss behind it
            volumes[0] = volumes[0]._replace(missing="")
        places = [after.place if after else None, *(None for _ in volumes[1:])]
        reads = zip(volumes, (partial(read, place) for place in places), strict=True)
        return in_one(order, reads)


def open_indexed(path: str | Path) -> IndexedCapture | None:
    """Open a capture by its index, in a time that does not depend on its data.

    None if that is not possible, because the file is foreign, was not finished, or anything about
    its index does not fit: then `open_capture` opens it or says what is wrong. Raises nothing.
    """
    path = Path(path)
    parts = kept_parts(path) or {1: path}
    indexes: list[Index] = []
    for file in parts.values():
        index = _index_of(file)
        if index is None:
            return None
        indexes.append(index)
    held = [
        (number, file, index.contents)
        for (number, file), index in zip(parts.items(), indexes, strict=True)
    ]
    try:
        volumes = volumes_of(path, held)
    except CaptureError:
        return None
    contents = volumes[0].contents if volumes[0].path == path else merged(volumes)
    opened = capture_of(path, contents, volumes)
    known = {one.name: getattr(opened, one.name) for one in fields(opened)}
    return IndexedCapture(**known, indexes=tuple(indexes))


def _index_of(path: Path) -> Index | None:
    """The index of a file with traffic that says when it began; None if there is none."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            index = read_index(file, size) if file.read(len(MAGIC)) == MAGIC else None
    except (OSError, ValueError):
        return None
    if index is None or not {topics.HOST_RAW, topics.DEVICE_RAW} & index.contents.counts.keys():
        return None
    start = index.contents.starts[0] if index.contents.starts else ""
    return index if start.isascii() and start.isdigit() and len(start) <= 20 else None


def _checkpoints(
    source: RecordFile, chunk: IndexedChunk, start: int
) -> Iterator[tuple[Checkpoint, Place]]:
    """Yield the checkpoints of a chunk, the last one first; none if the chunk is not as indexed."""
    try:
        found = source.record(chunk.offset)
        if found.opcode != records.CHUNK or found.end != chunk.offset + chunk.size:
            return
        parts = list(records.records_in(found.content))
    except Damaged:
        return
    for opcode, at, end in reversed(parts):
        if opcode != records.MESSAGE or end - at > records.MESSAGE_BYTES:
            continue
        channel, sequence, log_time, _ = records.MESSAGE_HEAD.unpack_from(found.content, at)
        if channel != _CHECKPOINTS:
            continue
        try:
            text = found.content[at + records.MESSAGE_HEAD.size : end]
            value = msgspec.json.decode(text, type=Checkpoint)
        except JSON_ERRORS:
            continue
        if value.t == log_time - start:
            yield value, Place(chunk.offset, end, sequence)


def _check_size(descriptor: int, size: int) -> None:
    if os.fstat(descriptor).st_size != size:
        raise Damaged("it has another size")
