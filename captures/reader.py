"""Reads the events of a capture file in order, from any MCAP writer, also damaged or unfinished."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from dataclasses import replace as with_changes
from functools import partial
from io import BufferedReader, FileIO
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

from mcap.opcode import Opcode
from mcap.records import Attachment

from bilprov.captures import schemas, topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.events import Events
from bilprov.captures.parts import Volume, kept_parts, merged, volumes_of
from bilprov.captures.recorded import Values, batches_of, one_by_one, recorded_values
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Look, Message, Recorded
from bilprov.captures.storage import contents as storage
from bilprov.captures.storage.blocks import Messages, Stored, blocks_of
from bilprov.captures.storage.contents import Contents, Order, Place, put_in_order
from bilprov.captures.storage.records import MAGIC, Damaged, decoded
from bilprov.captures.storage.recovery import WINDOW, Found, Lost, RecordFile, read_footer
from bilprov.captures.storage.survey import Survey
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import since, stated_number

Item = TypeVar("Item")
_READ_AHEAD = 1 << 16  # bytes: a chunk of short messages is smaller, and takes ten small reads
_Kinds: TypeAlias = Mapping[str, type]
_EVENTS: _Kinds = {topics.LINE: Line, topics.CHECKPOINT: Checkpoint}
_SIGHTS: _Kinds = {**_EVENTS, topics.LOOKS: topics.CarLook}
_RECORDED: _Kinds = {**_SIGHTS, topics.CASES: schemas.CaseMark, topics.ASKS: schemas.Asked}
_DECIDES = attrgetter("own", "in_order", "counted", "metadata", "channels")
"""What of a file's contents decides how its messages are read."""


class StoredCheckpoint(NamedTuple):
    """A checkpoint of a file, and the place of its message: what stands behind it comes after.

    `volume` tells in which of the capture's volumes, counted from 0.
    """

    value: Checkpoint
    place: Place
    volume: int


@dataclass(frozen=True, slots=True)
class Capture:
    """An opened capture; it can be read any number of times, and the file is closed in between.

    All that it gives is safe to show and to compute with: texts print and have 200 characters at
    most, and times are within `LONGEST` of the start. As stored, for a copy, are `messages()`,
    `recorded()`, `attachments()`, `grammar_text` and the values of `contents.metadata`.

    `start` is the wall clock in ns at `t` = 0; `metadata` is the record `bilprov` without the
    grammar's text, empty if there is none. `unfinished` is true if the
    writer never closed the file: then the complete records are read. `damage` has a sentence for
    each part that is left out.

    `volumes` are its files: of a recording that is kept in parts, those that are there. `path` is
    then the name that stands for all of them, and `contents` are those of all together.

    If it is `indexed`, it was opened by the indexes of its volumes: then `damage` and
    `contents.sizes` are empty, and unless it was verified nobody looked for damage. Where a part
    turns out to be damaged, it is left out and a Line `gap` is inserted, as after a survey.

    `surveys` are those of its volumes if only its front is known (`open_front`), None otherwise.
    `walked` counts the bytes of its files that were passed.
    """

    path: Path
    start: int
    metadata: dict[str, str]
    unfinished: bool
    damage: tuple[str, ...]
    contents: Contents = field(repr=False)
    volumes: tuple[Volume, ...] = field(repr=False)
    surveys: list[Survey] | None = field(default=None, repr=False)
    walked: list[int] = field(default_factory=lambda: [0], repr=False, compare=False)

    def __iter__(self) -> Iterator[Chunk | Line]:
        """The same as `events()`."""
        return self.events()

    def events(self, after: StoredCheckpoint | None = None) -> Iterator[Chunk | Line]:
        """Yield the chunks and line events in order, for decoding; those behind `after` if given.

        Where messages are lost by damage to the file, a Line `gap` is inserted. A checkpoint that
        `resumes` is a Resumption, with the `gap` right before it if there is one. Raises
        CaptureError if the file changed since it was opened or cannot be read.
        """
        return one_by_one(self._values(after, _EVENTS))

    def batches(self, after: StoredCheckpoint | None = None) -> Iterator[Events]:
        """Yield the same as `events`, in the same order, as arrays of some 64 k to 256 k rows.

        Raises CaptureError as `events` does.
        """
        return batches_of(self._values(after, _EVENTS))

    @property
    def passed(self) -> int:
        """How many bytes of the files were passed, each time that they were read."""
        return self.walked[0]

    def whole(self) -> Capture | None:
        """The capture with all that is in it, after the last of `batches`.

        None if its front does not tell how all of it is read: then what was read is void.
        """
        if self.surveys is None:
            return self
        contents = [survey.contents() for survey in self.surveys]
        as_told = [_DECIDES(volume.contents) for volume in self.volumes]
        if as_told != [*map(_DECIDES, contents)] or any(one.damage for one in contents):
            return None
        both = zip(self.volumes, contents, strict=True)
        volumes = tuple(volume._replace(contents=one) for volume, one in both)
        whole = _capture_of(self.path, volumes, cut_short=self.unfinished)
        return whole if whole.start == self.start else None

    def sights(self, after: StoredCheckpoint | None = None) -> Iterator[Chunk | Line | Look]:
        """Yield the events and the looks of a conformance run, in order, as `events` does."""
        return one_by_one(self._values(after, _SIGHTS))

    def recorded(
        self, after: StoredCheckpoint | None = None, looks: type[Look] = topics.CarLook
    ) -> Iterator[Recorded]:
        """Yield all that was recorded and not decoded from the bytes, as `events` does.

        Texts and numbers are as stored, so that a copy has them too; `looks` is the class of looks
        at the device.
        """
        kinds = {**_RECORDED, topics.LOOKS: looks}
        return one_by_one(self._values(after, kinds, as_stored=True))

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages of all topics that the file describes, or of those `wanted`, in order.

        Raises CaptureError if the file changed since it was opened or cannot be read.
        """
        for message in self._stored():
            if message.channel in self.contents.channels:
                topic, _ = self.contents.channels[message.channel]
                if wanted is None or topic in wanted:
                    t = since(self.start, message.log_time)
                    yield Message(topic, t, message.data, message.sequence)

    def losses(self) -> Iterator[tuple[int, int, str]]:
        """Yield the places where messages are lost: the times (ns) beside each, and what is lost.

        The times are those of the messages before and after it, since the capture's start. What is
        lost behind the last message is no such place: `left_out` counts its bytes. Raises
        CaptureError as `events`.
        """
        before = 0
        for message in self._stored():
            t = since(self.start, message.log_time)
            if message.lost:
                yield min(before, t), t, message.lost
            before = max(before, t)

    def number(self, key: str) -> int | None:
        """The number that an entry of the metadata states, None if it states none."""
        return stated_number(self.metadata.get(key))

    @property
    def grammar_text(self) -> str:
        """The text of the grammar by which it was recorded, as stored; "" if the file has none."""
        return self.contents.metadata.get(topics.GRAMMAR_TEXT, "")

    @property
    def indexed(self) -> bool:
        """Whether it was opened by its index."""
        return self.contents.index is not None

    @property
    def in_parts(self) -> bool:
        """Whether it is the parts of a recording, and not one file."""
        return self.volumes[0].path.name != self.path.name

    @property
    def left_out(self) -> int:
        """How many bytes of the file are not read, because they are damaged or incomplete."""
        regions = [region for volume in self.volumes for region in volume.contents.regions]
        read = len(MAGIC) * len(self.volumes) + sum(end - first for first, end in regions)
        return self.contents.size - read

    def attachments(self) -> Iterator[Attachment]:
        """Yield the complete attachments in file order. Raises CaptureError as `events` does."""
        for volume in self.volumes:
            yield from _read_volume(volume, storage.attachments)

    def checkpoint_before(self, t: int, grammar: str | None = None) -> StoredCheckpoint | None:
        """The last checkpoint with a time below `t` (ns since the capture's start), None without.

        With `grammar`, its decoder's grammar has that sha256. A checkpoint that is damaged, or is
        not what it says it is, is passed over for the one before it. There is none in a capture
        that was not opened by its index. Raises CaptureError as `events` does.
        """
        recorded = self.metadata.get(topics.GRAMMAR_HASH)
        other = grammar and recorded and recorded != grammar
        if other or not self.contents.counts.get(topics.CHECKPOINT):
            return None
        read = partial(storage.checkpoints_before, time=self.start + t)
        for number in reversed(range(len(self.volumes) if self.indexed else 0)):
            for log_time, value, place in _read_volume(self.volumes[number], read):
                itself = value.t == log_time - self.start and value.whole
                if itself and value.t < t and grammar in (None, value.grammar):
                    return StoredCheckpoint(value, place, number)
        return None

    def _values(
        self, after: StoredCheckpoint | None, wanted: _Kinds, *, as_stored: bool = False
    ) -> Values:

        names = {channel: topic for channel, (topic, _) in self.contents.channels.items()}
        return recorded_values(self.start, names, self._blocks(after), wanted, as_stored)

    def _stored(self) -> Iterator[Stored]:
        for block in self._blocks():
            yield from block.single()

    def _blocks(self, after: StoredCheckpoint | None = None) -> Iterator[Messages]:
        """Yield the messages of all volumes as those of one file.

        Each part of a recording begins with a checkpoint for those who read it alone. Where nothing
        is missing before it, decoding is in that state anyway, and it is left out.
        """
        whole = self.volumes[0].contents.metadata.get(topics.PART, "1") == "1"
        order = Order(0 if whole else None)
        first, place = (after.volume, after.place) if after else (0, None)
        if place:
            order.expected = (place.sequence + 1) & 0xFFFF_FFFF
        for number, volume in enumerate(self.volumes[first:], first):
            # What is missing before the part of a checkpoint is no loss behind it.
            order.missing = "" if place else volume.missing
            blocks = _read_volume(volume, partial(self._walk, order, place))
            place = None
            if number > first:
                begin = next(blocks, None)
                if begin and not begin.lost and _resumes(next(begin.single())):
                    begin = begin.rows(slice(1, None))
                if begin:
                    yield begin
            yield from blocks

    def _walk(
        self, order: Order, place: Place | None, file: BufferedReader, contents: Contents
    ) -> Iterator[Messages]:
        """Yield the messages of a file, and count how much of it was passed."""
        if self.surveys is None:
            blocks = blocks_of(storage.pieces(file, contents, place))
        else:
            self.surveys.append(Survey(file, contents.size))
            blocks = self.surveys[-1].blocks()
        before = 0
        for block in put_in_order(blocks, contents, order):
            if self.surveys and self.surveys[-1].notes:  # `whole` is None then
                return
            self.walked[0] += file.tell() - before
            before = file.tell()
            yield block


def _read_volume(
    volume: Volume, read: Callable[[BufferedReader, Contents], Iterator[Item]]
) -> Iterator[Item]:
    """Yield what `read` yields of a volume. Raises CaptureError as `Capture.events` does."""
    with _opened(volume.path) as file:
        _check_size(file, volume.contents)
        yield from read(file, volume.contents)
        _check_size(file, volume.contents)


@contextmanager
def _opened(path: Path) -> Iterator[BufferedReader[Any]]:
    """Open a file that is read from front to end. Raises CaptureError where that fails."""
    try:
        with BufferedReader(FileIO(path), _READ_AHEAD) as file:
            yield file
    except Damaged as error:
        raise CaptureError(
            f"{printable(path)} changed while it was read ({error}): open it again"
        ) from error
    except FileNotFoundError as error:
        raise CaptureError(f"{printable(path)} does not exist: name an MCAP file") from error
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise CaptureError(
            f"{printable(path)} cannot be read ({printable(why)}): name a readable MCAP file"
        ) from error


def _size_of(file: BufferedReader) -> int:
    return os.fstat(file.fileno()).st_size


def _check_size(file: BufferedReader, contents: Contents) -> None:
    """Raise Damaged if a file that was opened by its index has changed since."""
    if contents.index and _size_of(file) != contents.size:
        raise Damaged("it has another size")


def _resumes(message: Stored) -> bool:
    stands_there = message.channel == topics.BY_VALUE[Checkpoint].channel
    value = decoded(message.data, Checkpoint) if stands_there else None
    return value is not None and bool(value.resumes)


def open_front(path: str | Path) -> Capture:
    """Open a capture of which only the front is read; all of it where that does not tell enough.

    A front can only give its `batches`, once, and in doing so is surveyed: `whole` is all that
    there is to know. Raises CaptureError as `open_capture` does.
    """
    with suppress(CaptureError):
        front = open_capture(path, front=True)
        if not any(volume.contents.damage for volume in front.volumes):
            return with_changes(front, surveys=[])
    return open_capture(path)


def open_capture(path: str | Path, *, front: bool = False) -> Capture:
    """Open a capture and survey it in one pass with bounded memory, or only its `front`.

    Where there is no such file, but parts of a recording under this name (`drive.00001.mcap` and so
    on for `drive.mcap`), they are opened as one capture.

    Raises CaptureError if the file does not exist, is no MCAP file, or has neither a `/host/raw`
    nor a `/device/raw` topic; also if the parts are not of one recording.
    """
    path = Path(path)
    parts = kept_parts(path)
    held: list[tuple[int, Path, Contents]] = []
    for number, part in (parts or {1: path}).items():
        # What killed the program may have come before the newest part had a whole front.
        may_be_cut = len(parts) > 1 and number == max(parts)
        if may_be_cut and part.is_file() and not part.stat().st_size:
            continue
        contents = _surveyed(part, front)
        begun = contents.start or not contents.unfinished or any(contents.counts.values())
        if begun or not may_be_cut:
            _check_topics(part, contents)
            held.append((number, part, contents))
    return _capture_of(path, volumes_of(path, held), cut_short=len(held) < len(parts))


def appended(capture: Capture) -> Capture | None:
    """What a writer has added to an unfinished capture of one file, as a capture of its own.

    None where no complete record was added. Raises CaptureError if the file cannot be read.
    """
    volume = capture.volumes[0]
    start = end = volume.contents.regions[-1][1]
    with _opened(volume.path) as file:
        size = _size_of(file)
        for found in RecordFile(file, size).walk(start, size):
            if isinstance(found, Lost):
                break
            end = found.end
        finished = bool(read_footer(file, size))
    if end == start:
        return None
    # Its messages are counted on from those before, which a capture by itself would miss.
    contents = with_changes(volume.contents, size=size, regions=((start, end),), counted=False)
    volumes = (volume._replace(contents=contents),)
    return with_changes(capture, contents=contents, volumes=volumes, unfinished=not finished)


def open_indexed(path: str | Path) -> Capture | None:
    """Open a capture by its index, in a time that does not depend on its data.

    None if that is not possible, because the file is foreign, was not finished, or anything about
    its index does not fit: then `open_capture` opens it or says what is wrong. Raises nothing.
    """
    path = Path(path)
    held: list[tuple[int, Path, Contents]] = []
    for number, file in (kept_parts(path) or {1: path}).items():
        contents = _indexed(file)
        if contents is None:
            return None
        held.append((number, file, contents))
    try:
        return _capture_of(path, volumes_of(path, held))
    except CaptureError:
        return None


def open_quickly(path: str | Path) -> Capture:
    """Open a capture by its index, or as `open_capture` does where that is not possible."""
    return open_indexed(path) or open_capture(path)


def open_verified(path: str | Path) -> Capture:
    """Open a capture by its index where a checksum covers all data, or as `open_capture` does.

    In the first case nothing is damaged, and the sizes by topic are not known.
    """
    capture = open_indexed(path)
    return capture if capture and _is_unchanged(capture) else open_capture(path)


def _is_unchanged(capture: Capture) -> bool:
    """Whether the checksums over all data of a capture's files are right."""
    for volume in capture.volumes:
        with _opened(volume.path) as file:
            if not (volume.contents.index and volume.contents.index.covers(file)):
                return False
    return True


def _indexed(path: Path) -> Contents | None:
    """The contents of a file as its index tells them; None if there is none."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            return storage.read_index(file, _size_of(file))
    except (OSError, ValueError):
        return None


def _capture_of(path: Path, volumes: tuple[Volume, ...], *, cut_short: bool = False) -> Capture:
    contents = volumes[0].contents if volumes[0].path == path else merged(volumes)
    start = contents.start
    first, last = (start + since(start, time) for time in (contents.first, contents.last))
    contents = with_changes(contents, first=first, last=last)
    shown = {printable(key): printable(text) for key, text in contents.metadata.items()}
    shown.pop(topics.GRAMMAR_TEXT, None)
    unfinished = contents.unfinished or cut_short
    return Capture(path, start, shown, unfinished, contents.damage, contents, volumes)


def _surveyed(path: Path, front: bool) -> Contents:

    with suppress(OSError, ValueError):  # to open it tells why
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
            raise CaptureError(f"{printable(path)} is {kind}: name an MCAP file")
    with _opened(path) as file:
        size = _size_of(file)
        survey = Survey(file, size, _magic_damage(path, file, size))
        for _ in survey.blocks():
            if front:
                break
        return survey.contents()


def _magic_damage(path: Path, file: BufferedReader, size: int) -> str:
    """What is damaged of the first bytes of an MCAP file, "" for nothing.

    Raises CaptureError for what is no MCAP file: without its magic, and without a chunk with a
    correct checksum behind the first bytes.
    """
    front = file.read(len(MAGIC))
    if not front:
        raise CaptureError(f"{printable(path)} is empty: name an MCAP file")
    if front == MAGIC:
        return ""
    source = RecordFile(file, size)
    source.own = True  # only chunks with a checksum
    if source.next_chunk(0, until=WINDOW) is None:
        raise CaptureError(
            f"{printable(path)} is not MCAP (first bytes {front.hex(' ')}, MCAP has "
            f"{MAGIC.hex(' ')}): name an MCAP file"
        )
    return f"the first bytes are damaged ({front.hex(' ')} in place of {MAGIC.hex(' ')})"


def _check_topics(path: Path, contents: Contents) -> None:
    held = sorted({topic for topic, _ in contents.channels.values()})
    if topics.HOST_RAW in held or topics.DEVICE_RAW in held:
        return
    listed = f"topics {printable(', '.join(held))}" if held else "no topics"
    raise CaptureError(
        f"{printable(path)} holds {listed}; bilprov needs {topics.HOST_RAW} or {topics.DEVICE_RAW}"
    )


class Evidence(NamedTuple):
    """A capture whose content is unchanged, and the requested attachments by name.

    `capture.unfinished` is true for a file that was never finished; its complete records are then
    covered by the checksums of its chunks and attachments.
    """

    capture: Capture
    attachments: dict[str, bytes]


def open_evidence(path: str | Path, wanted: Collection[str]) -> Evidence:
    """Open a capture of bilprov, check every byte, and read the attachments named in `wanted`.

    A finished file is covered without a gap: one checksum covers all data, another one the summary.
    Checksums detect damage, not forgery. Raises CaptureError for a damaged file, in one sentence
    that says which checksum is wrong; also for a file that another program has saved.
    """
    path = Path(path)
    parts = kept_parts(path)
    if parts:
        raise CaptureError(
            f"{printable(path)} is kept in parts, each with checksums of its own: name one of "
            f"them, like {printable(next(iter(parts.values())))}"
        )
    capture = open_capture(path)
    wrong = next(iter(capture.damage), "") or _wrong_checksum(path, capture.unfinished)
    if not capture.damage and not capture.contents.own:
        raise CaptureError(
            f"{printable(path)} was saved by another program ({capture.contents.library}), not "
            "all of it is covered by a checksum (CRC): name the file as bilprov wrote it"
        )
    if wrong:
        raise CaptureError(
            f"{printable(path)} is damaged: a checksum (CRC) does not match; {printable(wrong)}"
        )
    return Evidence(
        capture, {file.name: file.data for file in capture.attachments() if file.name in wanted}
    )


def _wrong_checksum(path: Path, unfinished: bool) -> str:
    """Which checksum outside of the chunks is wrong, "" for none."""
    with _opened(path) as file:
        size = _size_of(file)
        if unfinished:
            walk = RecordFile(file, size).walk(len(MAGIC), size, only=())
            ended = any(isinstance(one, Found) and one.opcode == Opcode.DATA_END for one in walk)
            return "that of the summary, which is cut off" if ended else ""
        contents = storage.read_index(file, size)
        if contents is None or contents.index is None:
            return "that of the summary, or the file does not begin and end as bilprov's do"
        # Older kits wrote none over all data.
        right = not contents.index.data_crc or contents.index.covers(file)
    return "" if right else "that over all data"
