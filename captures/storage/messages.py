"""Reads the messages of a surveyed file in order, each with a note of what is lost before it."""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedReader
from typing import NamedTuple

from bilprov.captures.storage import records
from bilprov.captures.storage.contents import Contents
from bilprov.captures.storage.limits import MESSAGE_BYTES
from bilprov.captures.storage.recovery import SKIPPED, RecordFile
from bilprov.captures.storage.time_order import TimeWindow


class Stored(NamedTuple):
    """A message as stored in the file; `lost` says what is missing before it, "" for nothing."""

    log_time: int
    sequence: int
    channel: int
    data: bytes
    lost: str


def stored_messages(file: BufferedReader, contents: Contents) -> Iterator[Stored]:
    """Yield the messages of an open file: of our own files in file order, of others by time.

    Raises Damaged if the file has changed since the survey.
    """
    if contents.own:
        return _in_file_order(file, contents)
    return _by_time(_in_file_order(file, contents))


def _in_file_order(file: BufferedReader, contents: Contents) -> Iterator[Stored]:
    unpack = records.MESSAGE_HEAD.unpack_from
    head = records.MESSAGE_HEAD.size
    expected = 0
    lost = ""
    for content, start, end, where in _spans(file, contents):
        if where:
            lost = where
        if end - start - head > MESSAGE_BYTES:
            lost = "a message that is too long is left out here"
            continue
        channel, sequence, log_time, _ = unpack(content, start)
        if contents.counted:
            missing = (sequence - expected) & 0xFFFF_FFFF
            expected = (sequence + 1) & 0xFFFF_FFFF
            lost = f"{missing} messages are lost here, the file is damaged" if missing else ""
        yield Stored(log_time, sequence, channel, content[start + head : end], lost)
        lost = ""


def _spans(file: BufferedReader, contents: Contents) -> Iterator[tuple[bytes, int, int, str]]:
    # The survey has checked each record of these regions; here they only must still be complete.
    source = RecordFile(file, contents.size)
    source.past_data = True
    where = ""
    for at, region_end in contents.regions:
        offset = at
        while offset < region_end:
            found = source.record(offset)
            offset = found.end
            if found.opcode == records.CHUNK:
                for opcode, start, end in records.records_in(found.content):
                    if opcode == records.MESSAGE:
                        yield found.content, start, end, where
                        where = ""
            elif found.opcode == records.MESSAGE:
                yield found.content, 0, len(found.content), where
                where = ""
            elif found.opcode == SKIPPED:
                where = "a chunk or message that is too large is left out here"
            elif found.opcode == records.FOOTER:
                return
        where = "the file is damaged here"


def _by_time(messages: Iterator[Stored]) -> Iterator[Stored]:
    window: TimeWindow[Stored] = TimeWindow()
    for message in messages:
        yield from window.push(message.log_time, len(message.data), message)
    yield from window.rest()
