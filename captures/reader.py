"""Reads the events of a capture file in order, from any MCAP writer, also damaged or unfinished."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from dataclasses import replace as with_changes
from functools import partial
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.events import DEVICE, HOST, LINE, SIDES, Events
from bilprov.captures.parts import Volume, kept_parts, merged, start_of, volumes_of
from bilprov.captures.schemas import (
    Asked,
    CaseMark,
    Checkpoint,
    Chunk,
    Line,
    Look,
    Resumption,
)
from bilprov.captures.storage.blocks import BLOCK_MESSAGES, Messages, Stored
from bilprov.captures.storage.messages import (
    Contents,
    Order,
    Part,
    attachments,
    single,
    stored_parts,
)
from bilprov.captures.storage.records import MAGIC, AttachmentRecord, Damaged
from bilprov.captures.storage.recovery import WINDOW, RecordFile
from bilprov.captures.storage.survey import JSON_ERRORS, surveyed
from bilprov.captures.text import printable

TOPICS_SHOWN = 10
_FLIPPED = 2  # bits of the magic that may differ: other kinds of files differ in more

Item = TypeVar("Item")
Recorded: TypeAlias = Chunk | Line | Look | CaseMark | Asked | Checkpoint
LONGEST = 1 << 62  # ns before and after a capture's start; times beyond are taken for this
_SIDES = {topics.HOST_RAW: HOST, topics.DEVICE_RAW: DEVICE}
_OTHER = 255  # the code of a message that is neither of a side nor wanted
_EVENTS = {topics.LINE, topics.CHECKPOINT}
_RECORDED: dict[str, type[Line | Look | CaseMark | Asked | Checkpoint]] = {
    topics.LINE: Line,
    topics.LOOKS: Look,
    topics.CASES: CaseMark,
    topics.ASKS: Asked,
    topics.CHECKPOINT: Checkpoint,
}


class Message(msgspec.Struct, frozen=True):
    """One message of any topic.

    `t` is ns since the capture's start; `value` is the decoded JSON object, with None for fields
    that a bilprov message left out, or the bytes if the message is not a JSON object. Its text is
    foreign: show it only through `captures.text.printable`.
    """

    topic: str
    t: int
    value: dict[str, Any] | bytes
    sequence: int

    @property
    def t_ns(self) -> int:
        """The same as `t`, under the name that tells its unit."""
        return self.t


class Loss(NamedTuple):
    """A place where messages of a capture are lost: the times (ns) beside it, and what is lost.

    The times are those of the messages before and after it, since the capture's start. What is lost
    behind the last message is no such place: `Capture.left_out` counts its bytes.
    """

    before: int
    after: int
    what: str


@dataclass(frozen=True, slots=True)
class Capture:
    """An opened capture; it can be read any number of times, and the file is closed in between.

    `start` is the wall clock in ns at `t` = 0; `metadata` is the record `bilprov`, empty if there
    is none; `library` names the writer. `unfinished` is true if the writer never closed the file:
    then the complete records are read. `damage` has a sentence for each part that is left out.

    `volumes` are its files: of a recording that is kept in parts, those that are there. `path` is
    then the name that stands for all of them, and `contents` are those of all together.
    """

    path: Path
    start: int
    metadata: dict[str, str]
    library: str
    unfinished: bool
    damage: tuple[str, ...]
    contents: Contents = field(repr=False)
    volumes: tuple[Volume, ...] = field(repr=False)

    def __iter__(self) -> Iterator[Chunk | Line]:
        """The same as `events()`."""
        return self.events()

    def events(self) -> Iterator[Chunk | Line]:
        """Yield the chunks and line events in order, for decoding.

        Where messages are lost by damage to the file, a Line `gap` is inserted. A checkpoint that
        `resumes` is a Resumption, with the `gap` right before it if there is one. Raises
        CaptureError if the file changed since it was opened or cannot be read.
        """
        return events_of(self, self._stored())

    def batches(self) -> Iterator[Events]:
        """Yield the same as `events()`, in the same order, as arrays of some 64 k to 256 k rows.

        Raises CaptureError as `events` does.
        """
        return batches_of(self, self._parts())

    def sights(self) -> Iterator[Chunk | Line | Look]:
        """Yield the events and the looks of a conformance run, in order.

        Raises CaptureError as `events` does.
        """
        return sights_of(self, self._stored())

    def recorded(self) -> Iterator[Recorded]:
        """Yield all that was recorded and not decoded from the bytes, in order.

        Resumptions are as in `events`. Raises CaptureError as `events` does.
        """
        return recorded_of(self, self._stored())

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages of all topics that the file describes, or of those `wanted`, in order.

        Raises CaptureError if the file changed since it was opened or cannot be read.
        """
        for message in self._stored():
            if message.channel in self.contents.channels:
                topic, encoding = self.contents.channels[message.channel]
                if wanted is not None and topic not in wanted:
                    continue
                value = _value(topic, encoding, message.data)
                yield Message(topic, message.log_time - self.start, value, message.sequence)

    def losses(self) -> Iterator[Loss]:
        """Yield the places where messages are lost, in order. Raises CaptureError as `events`."""
        before = 0
        for message in self._stored():
            t = message.log_time - self.start
            if message.lost:
                yield Loss(min(before, t), t, message.lost)
            before = max(before, t)

    @property
    def in_parts(self) -> bool:
        """Whether it is the parts of a recording, and not one file."""
        return self.volumes[0].path.name != self.path.name

    @property
    def left_out(self) -> int:
        """How many bytes of the file are not read, because they are damaged or incomplete."""
        return sum(_left_out(volume.contents) for volume in self.volumes)

    def attachments(self) -> Iterator[AttachmentRecord]:
        """Yield the complete attachments in file order. Raises CaptureError as `events` does."""
        for volume in self.volumes:
            yield from read_volume(volume, attachments)

    def _stored(self) -> Iterator[Stored]:
        return single(self._parts())

    def _parts(self) -> Iterator[Part]:
        order = Order(first_expected(self))
        reads = ((volume, partial(stored_parts, order=order)) for volume in self.volumes)
        return in_one(order, reads)


Read: TypeAlias = Callable[[BufferedReader, Contents], Iterator[Item]]


def read_volume(volume: Volume, read: Read[Item]) -> Iterator[Item]:
    """Yield what `read` yields of a volume. Raises CaptureError as `Capture.events` does."""
    try:
        with volume.path.open("rb") as file:
            yield from read(file, volume.contents)
    except Damaged as error:
        raise changed(volume.path, error) from error
    except OSError as error:
        raise unreadable(volume.path, error) from error


def first_expected(capture: Capture) -> int | None:
    """The sequence number with which a capture begins, None for a later part of a recording."""
    return None if capture.volumes[0].contents.metadata.get(topics.PART, "1") != "1" else 0


def in_one(order: Order, reads: Iterable[tuple[Volume, Read[Part]]]) -> Iterator[Part]:
    """Yield the messages of some volumes, which `order` counts, as those of one file.

    Each part begins with a checkpoint for those who read it alone. Where nothing is missing before
    it, decoding is in that state anyway, and it is left out.
    """
    for number, (volume, read) in enumerate(reads):
        order.missing = volume.missing
        stored = read_volume(volume, read)
        begin = next(stored, None) if number else None
        if isinstance(begin, Messages):
            stored = chain([begin.part(1)], stored)
            begin = next(begin.part(0, 1).single())
        if begin and (begin.lost or not _resumes(begin)):
            yield begin
        yield from stored


def _resumes(message: Stored) -> bool:
    if message.channel != topics.BY_VALUE[Checkpoint].channel:
        return False
    try:
        return bool(msgspec.json.decode(message.data, type=Checkpoint).resumes)
    except JSON_ERRORS:
        return False


def _left_out(contents: Contents) -> int:
    read = sum(end - first for first, end in contents.regions)
    return contents.size - min(len(MAGIC), contents.size) - read


def events_of(capture: Capture, stored: Iterator[Stored]) -> Iterator[Chunk | Line]:
    """The chunks and line events among stored messages, as `Capture.events` says."""
    for value in recorded_of(capture, stored, _EVENTS):
        if isinstance(value, Chunk | Line):
            yield value


def batches_of(capture: Capture, parts: Iterator[Part]) -> Iterator[Events]:
    """The events among stored messages as arrays, as `Capture.batches` says."""
    held: list[Events | Chunk | Line] = []
    rows = 0
    for value in _with_resumptions(_recorded(capture, parts, _EVENTS)):
        if isinstance(value, Events | Chunk | Line):
            held.append(value)
            rows += len(value) if isinstance(value, Events) else 1
            if rows >= BLOCK_MESSAGES:
                yield Events.joined(held)
                held, rows = [], 0
    if held:
        yield Events.joined(held)


def sights_of(capture: Capture, stored: Iterator[Stored]) -> Iterator[Chunk | Line | Look]:
    """The events and looks among stored messages, as `Capture.sights` says."""
    for value in recorded_of(capture, stored, {*_EVENTS, topics.LOOKS}):
        if isinstance(value, Chunk | Line | Look):
            yield value


def recorded_of(
    capture: Capture,
    stored: Iterator[Stored],
    wanted: Collection[str] = _RECORDED.keys(),
) -> Iterator[Recorded]:
    """The raw chunks among stored messages, and the values of the topics that are `wanted`."""
    for value in _with_resumptions(_recorded(capture, stored, wanted)):
        if not isinstance(value, Events):
            yield value


def _with_resumptions(values: Iterator[Recorded | Events]) -> Iterator[Recorded | Events]:
    gap: Line | None = None
    for value in values:
        if isinstance(value, Checkpoint) and value.resumes:
            at = gap or Line(value.t, "gap")
            silent = gap is None
            yield Resumption(at.t, at.event, at.tap, at.detail, checkpoint=value, silent=silent)
            gap = None
            continue
        if gap:
            yield gap
            gap = None
        if isinstance(value, Line) and value.event == "gap":
            gap = value
        else:
            yield value
    if gap:
        yield gap


def _recorded(
    capture: Capture, parts: Iterator[Part], wanted: Collection[str]
) -> Iterator[Recorded | Events]:
    """The values of single messages; the raw chunks of whole blocks are arrays."""
    names = {channel: topic for channel, (topic, _) in capture.contents.channels.items()}
    codes = np.full(1 << 16, _OTHER, np.uint8)
    for channel, topic in names.items():
        codes[channel] = _SIDES.get(topic, LINE if topic in wanted else _OTHER)
    for part in parts:
        if isinstance(part, Messages):
            yield from _recorded_block(capture, part, names, codes)
            continue
        t = _since(capture.start, part.log_time)
        if part.lost:
            yield Line(t, "gap", "", part.lost)
        code = int(codes[part.channel])
        if code in (HOST, DEVICE):
            yield Chunk(t, SIDES[code], part.data)
        elif code == LINE:
            yield from _decoded(part.data, names[part.channel], t)


def _recorded_block(
    capture: Capture,
    block: Messages,
    names: Mapping[int, str],
    codes: NDArray[np.uint8],
) -> Iterator[Recorded | Events]:
    sides = codes[block.channel]
    raw = np.flatnonzero(sides <= DEVICE)
    t = _times_since(capture.start, block.log_time)
    sizes = (block.end - block.start)[raw]
    chunks = Events(t[raw], sides[raw], sizes, block.data(raw))
    others = np.flatnonzero(sides == LINE)
    done = 0
    for row, before in zip(others.tolist(), np.searchsorted(raw, others).tolist(), strict=True):
        if before > done:
            yield chunks.part(done, before)
            done = before
        data = block.content[block.start[row] : block.end[row]]
        yield from _decoded(data, names[int(block.channel[row])], int(t[row]))
    if done < len(chunks):
        yield chunks.part(done, len(chunks)) if done else chunks


def _decoded(data: bytes, topic: str, t: int) -> Iterator[Recorded]:
    try:
        value = msgspec.json.decode(data, type=_RECORDED[topic])
    except JSON_ERRORS:
        return
    yield replace(value, t=t)


def _since(start: int, log_time: int) -> int:
    return min(max(log_time - start, -LONGEST), LONGEST)


def _times_since(start: int, log_times: NDArray[np.uint64]) -> NDArray[np.int64]:
    most = (1 << 64) - 1
    limits = np.array([start - LONGEST, start + LONGEST], object).clip(0, most).astype(np.uint64)
    return (log_times.clip(*limits) - np.uint64(start)).view(np.int64)


def open_capture(path: str | Path) -> Capture:
    """Open a capture and survey it in one pass with bounded memory.

    Where there is no such file, but parts of a recording under this name (`drive.00001.mcap` and so
    on for `drive.mcap`), they are opened as one capture.

    Raises CaptureError if the file does not exist, is no MCAP file, or has neither a `/host/raw`
    nor a `/device/raw` topic; also if the parts are not of one recording.
    """
    path = Path(path)
    parts = kept_parts(path)
    if parts:
        return _opened_parts(path, parts)
    contents = _surveyed(path)
    _check_topics(path, contents)
    return capture_of(path, contents, (Volume(path, contents),))


def capture_of(path: Path, contents: Contents, volumes: tuple[Volume, ...]) -> Capture:
    """The capture of these volumes, which hold `contents` together."""
    return Capture(
        path=path,
        start=start_of(contents),
        metadata=contents.metadata,
        library=contents.library,
        unfinished=contents.unfinished,
        damage=contents.damage,
        contents=contents,
        volumes=volumes,
    )


def _opened_parts(path: Path, parts: Mapping[int, Path]) -> Capture:
    held: list[tuple[int, Path, Contents]] = []
    newest = max(parts)
    cut_short = False
    for number, part in parts.items():
        # What killed the program may have come before the newest part had a whole front.
        may_be_cut = number > min(parts) and number == newest
        contents = None if may_be_cut and _is_empty(part) else _surveyed(part)
        if contents is None or (may_be_cut and _is_hardly_begun(contents)):
            cut_short = True
            continue
        _check_topics(part, contents)
        held.append((number, part, contents))
    volumes = volumes_of(path, held)
    contents = merged(volumes)
    if cut_short:
        contents = with_changes(contents, unfinished=True)
    return capture_of(path, contents, volumes)


def _is_empty(path: Path) -> bool:
    try:
        return path.is_file() and not path.stat().st_size
    except OSError:
        return False


def _is_hardly_begun(contents: Contents) -> bool:
    return contents.unfinished and not contents.starts and not any(contents.counts.values())


def _surveyed(path: Path) -> Contents:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "not a regular file"
            raise CaptureError(f"{printable(path)} is {kind}: name an MCAP file")
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            damage = _magic_damage(path, file, size)
            return surveyed(file, size, damage)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def changed(path: Path, why: Damaged) -> CaptureError:
    """The error for a capture that is not what it was when it was opened."""
    return CaptureError(f"{printable(path)} changed while it was read ({why}): open it again")


def unreadable(path: Path, error: OSError | ValueError) -> CaptureError:
    """The error that says why a capture cannot be read."""
    if isinstance(error, FileNotFoundError):
        return CaptureError(f"{printable(path)} does not exist: name an MCAP file")
    why = error.strerror if isinstance(error, OSError) else error
    return CaptureError(
        f"{printable(path)} cannot be read ({printable(why)}): name a readable MCAP file"
    )


def _magic_damage(path: Path, file: BufferedReader, size: int) -> str:
    """What is damaged of the first bytes of an MCAP file, "" for nothing.

    Raises CaptureError for what is no MCAP file: neither do the first bytes look like its magic nor
    is there a chunk with a correct checksum behind them.
    """
    front = file.read(len(MAGIC))
    if not front:
        raise CaptureError(f"{printable(path)} is empty: name an MCAP file")
    if front == MAGIC:
        return ""
    source = RecordFile(file, size)
    source.own = True  # only chunks with a checksum
    flipped = int.from_bytes(front, "big") ^ int.from_bytes(MAGIC, "big")
    if flipped.bit_count() > _FLIPPED and source.next_chunk(0, until=WINDOW) is None:
        raise CaptureError(
            f"{printable(path)} is not MCAP (first bytes {front.hex(' ')}, MCAP has "
            f"{MAGIC.hex(' ')}): name an MCAP file"
        )
    return f"the first bytes are damaged ({front.hex(' ')} in place of {MAGIC.hex(' ')})"


def _check_topics(path: Path, contents: Contents) -> None:
    held = sorted({topic for topic, _ in contents.channels.values()})
    if topics.HOST_RAW in held or topics.DEVICE_RAW in held:
        return
    listed = ", ".join(held[:TOPICS_SHOWN]) + (", ..." if len(held) > TOPICS_SHOWN else "")
    raise CaptureError(
        f"{printable(path)} holds {'topics ' + printable(listed) if held else 'no topics'}; "
        f"bilprov needs {topics.HOST_RAW} or {topics.DEVICE_RAW}"
    )


def _value(topic: str, encoding: str, data: bytes) -> dict[str, Any] | bytes:
    if encoding != topics.JSON_ENCODING:
        return data
    try:
        value = msgspec.json.decode(data)
    except JSON_ERRORS:
        return data
    if not isinstance(value, dict):
        return data
    return topics.completed(topic, value)
