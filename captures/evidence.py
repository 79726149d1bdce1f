"""Opens a capture as evidence: checks every byte by a checksum, and reads attachments."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.storage.records import MAGIC
from bilprov.captures.text import printable


@dataclass(frozen=True, slots=True)
class Evidence:
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
            f"{printable(path)} was saved by another program ({capture.library}), not "
            "all of it is covered by a checksum (CRC): name the file as bilprov wrote it"
        )
    if wrong:
        raise CaptureError(
            f"{printable(path)} is damaged: a checksum (CRC) does not match; {printable(wrong)}"
        )
    attachments: dict[str, bytes] = {}
    for file in capture.attachments():
        if file.name in wanted:
            attachments.setdefault(file.name, file.data)
    return Evidence(capture, attachments)


def _wrong_checksum(path: Path, unfinished: bool) -> str:
    """Which checksum outside of the chunks is wrong, "" for none."""
    from bilprov.captures.storage.index import read_index
    from bilprov.captures.storage.recovery import Found, RecordFile

    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if unfinished:
            walk = RecordFile(file, size).walk(len(MAGIC), size, only=())
            ended = any(isinstance(one, Found) and one.opcode == Opcode.DATA_END for one in walk)
            return "that of the summary, which is cut off" if ended else ""
        contents = read_index(file, size)
        if contents is None or contents.index is None:
            return "that of the summary, or the file does not begin and end as bilprov's do"
        # Older kits wrote none over all data.
        right = not contents.index.data_crc or contents.index.covers(file)
    return "" if right else "that over all data"
