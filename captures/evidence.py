"""Opens a capture as evidence: checks every byte by a hash or a checksum, and reads attachments.

A finished file of bilprov is covered without a gap: the seal's sha256 covers all before the seal,
the seal and the end of the data have a fixed form, and the CRC of the summary covers the rest.
"""

from __future__ import annotations

import hashlib
import mmap
import re
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

from bilprov.captures.chunked_file import SEAL_BYTES, SEAL_HASH, SEAL_NAME
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.storage import records
from bilprov.captures.storage.records import ATTACHMENT_BYTES, MAGIC, RECORD_HEAD, Damaged
from bilprov.captures.storage.recovery import RecordFile
from bilprov.captures.text import printable

_SEAL = re.compile(rb"\x0c.{8}\x0c\x00{3}" + re.escape(SEAL_NAME.encode()), re.DOTALL)
_DATA_END = RECORD_HEAD.pack(records.DATA_END, records.DATA_END_BYTES) + bytes(4)
_FOOTER = RECORD_HEAD.pack(records.FOOTER, records.FOOTER_BYTES)
_FOOTER_FIELDS = Struct("<QQI")  # summary start, summary offset start, CRC
_END = len(_FOOTER) + records.FOOTER_BYTES + len(MAGIC)


@dataclass(frozen=True, slots=True)
class Evidence:
    """A capture whose content is unchanged, and the requested attachments by name.

    `sealed` is false for a file that was never finished; its complete records are then covered by
    the checksums of its chunks and attachments.
    """

    capture: Capture
    attachments: dict[str, bytes]
    sealed: bool


def open_evidence(path: str | Path, wanted: Collection[str]) -> Evidence:
    """Open a capture of bilprov, check every byte, and read the attachments named in `wanted`.

    Raises CaptureError for a damaged file, in one sentence that says which hash or checksum is
    wrong; also for a finished file without a seal.
    """
    path = Path(path)
    parts = kept_parts(path)
    if parts:
        raise CaptureError(
            f"{printable(path)} is kept in parts, each with a seal of its own: name one of them, "
            f"like {printable(next(iter(parts.values())))}"
        )
    content = _content(path)
    if content is None:
        capture = open_capture(path)  # raises the proper error for an empty or missing file
        raise CaptureError(f"{printable(capture.path)} changed while it was read: open it again")
    with content:
        seals = [found.start() for found in _SEAL.finditer(content)]
        finished = len(content) > len(MAGIC) and content[-len(MAGIC) :] == MAGIC
        if seals:
            _check_sealed(path, content, seals[-1])
        elif finished and content[: len(MAGIC)] == MAGIC:
            raise CaptureError(
                f"{printable(path)} has no seal, which is the hash (sha256) over its content: it "
                "was recorded by an older kit, saved by another program, or is damaged"
            )
        capture = open_capture(path)
        if capture.damage:
            raise CaptureError(_damaged(path, "a checksum (CRC) does not match", capture.damage))
        end = seals[-1] if seals else len(content)
        try:
            attachments = _attachments(content, end, wanted)
        except Damaged as damage:  # in a file of another program, where not all is checked
            raise CaptureError(_damaged(path, str(damage))) from damage
        return Evidence(capture, attachments, sealed=bool(seals))


def _content(path: Path) -> mmap.mmap | None:
    """The file's content, None if it is empty or cannot be read."""
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):
        return None


def _check_sealed(path: Path, content: mmap.mmap, seal: int) -> None:
    _, length = RECORD_HEAD.unpack_from(content, seal)
    end = seal + RECORD_HEAD.size + length
    try:
        if length > 4096 or end > len(content):
            raise Damaged("it ends elsewhere")
        name, pairs = records.metadata_record(content[seal + RECORD_HEAD.size : end], own=True)
    except Damaged as damage:
        told = f"the seal, which holds its hash (sha256), cannot be read ({damage})"
        raise CaptureError(_damaged(path, told)) from damage
    with memoryview(content) as view, view[:seal] as before:
        digest = hashlib.sha256(before).hexdigest()
    if (name, pairs) != (SEAL_NAME, {SEAL_HASH: digest, SEAL_BYTES: str(seal)}):
        told = f"the hash (sha256) over its first {seal} bytes is not the one in its seal"
        raise CaptureError(_damaged(path, told, _first_damage(path, seal)))
    if content[end : end + len(_DATA_END)] != _DATA_END:
        raise _damaged_behind_seal(path, f"the data do not end at byte {end}, where they have to")
    _check_end(path, content, end + len(_DATA_END))


def _check_end(path: Path, content: mmap.mmap, start: int) -> None:
    """Check the summary, which begins at `start`, the footer and the last bytes.

    Raises CaptureError.
    """
    at = len(content) - _END
    footer = content[max(at, 0) : len(content) - len(MAGIC)]
    fits = at >= start and footer.startswith(_FOOTER) and content[-len(MAGIC) :] == MAGIC
    if fits:
        summary, _, crc = _FOOTER_FIELDS.unpack_from(footer, len(_FOOTER))
        with memoryview(content) as view, view[start : len(content) - len(MAGIC) - 4] as covered:
            fits = summary == start and zlib.crc32(covered) == crc
    if not fits:
        what = f"the checksum (CRC) of the summary from byte {start} on does not"
        raise _damaged_behind_seal(path, f"{what}, or the file is cut off there")


def _first_damage(path: Path, seal: int) -> tuple[str, ...]:
    """A sentence about the first damaged record before the seal, if one is found."""
    at = len(MAGIC)
    with path.open("rb") as file:
        if file.read(at) != MAGIC:
            return ("its first bytes are not those of MCAP",)
        source = RecordFile(file, seal)
        source.own = True
        try:
            while at < seal:
                at = source.record(at).end
        except Damaged as damage:
            return (f"in the record at byte {at}: {damage}",)
    return ()


def _damaged_behind_seal(path: Path, what: str) -> CaptureError:
    name = printable(path)
    return CaptureError(f"{name} is damaged behind its seal: the hash (sha256) fits, but {what}")


def _damaged(path: Path, told: str, notes: tuple[str, ...] = ()) -> str:
    where = f"; {printable(notes[0])}" if notes else ""
    return f"{printable(path)} is damaged: {told}{where}"


def _attachments(content: mmap.mmap, end: int, wanted: Collection[str]) -> dict[str, bytes]:
    """The first attachment of each wanted name; all records are known to be complete here."""
    found: dict[str, bytes] = {}
    at = len(MAGIC)
    while at + RECORD_HEAD.size <= end:
        opcode, length = RECORD_HEAD.unpack_from(content, at)
        start, at = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        if opcode == records.ATTACHMENT and at <= end and length <= ATTACHMENT_BYTES + 1024:
            attached = records.attachment_record(content[start:at])
            if attached.name in wanted:
                found.setdefault(attached.name, attached.data)
    return found
