"""`bilprov sniff` while it listens to two ptys and records."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bilprov.analyzer.transport.port import PtyPair, open_pty
from bilprov.captures.parts import part_path
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from tests.support.commands import Running, running
from tests.support.wires import json_lines


@dataclass(frozen=True)
class Sniffing:
    """The taps, which other programs write to, and the command, which shows JSON lines."""

    host: PtyPair
    device: PtyPair
    command: Running
    path: Path

    def lines(self, count: int = 1) -> bytes:
        """The next lines of standard output, as they come, but for reports of a busy machine."""
        lines: list[bytes] = []
        while len(lines) < count:
            line = self.command.stdout.readline()
            assert line, self.command.stderr.read()
            lines += promptly(line).splitlines(keepends=True)
        return b"".join(lines)

    def row(self, words: str) -> dict[str, Any]:
        """The next row whose line has these words."""
        while words.encode() not in (line := self.lines()):
            pass
        return json_lines(line)[0]

    def error(self) -> str:
        """The next line of standard error."""
        return self.command.stderr.readline().decode()

    def fill_disk(self, room: int | None = None) -> None:
        """From now on the file system takes no byte more of a file, or no more than `room`."""
        size = self.path.stat().st_size if room is None else room
        resource.prlimit(self.command.process.pid, resource.RLIMIT_FSIZE, (size, size))


@contextmanager
def sniffing(path: Path, *more: str, taps: int = 2, form: str = "jsonl") -> Iterator[Sniffing]:
    """Sniff two taps, or the host's alone, until the block ends; its file is there when it begins.

    Without a tap of `taps` the words `more` name one.
    """
    with open_pty() as host, open_pty() as device:
        words = [pair.name for pair in (host, device)][:taps]
        words += ["-w", str(path), "--format", form, *more]
        with running("sniff", *words) as command:
            first = part_path(path, 1) if "--rotate" in more else path
            command.wait_for(first)
            yield Sniffing(host, device, command, first)


def promptly(output: bytes) -> bytes:
    """The lines without those that report that a busy machine did not let the sniffer read."""
    return b"".join(line for line in output.splitlines(keepends=True) if b'"waited"' not in line)


def write(pair: PtyPair, data: bytes) -> None:
    """What another program says on the line: the sniffer hears it on the pty's path."""
    while data:
        try:
            data = data[os.write(pair.master, data) :]
        except BlockingIOError:
            time.sleep(0.001)


def kept(path: Path, direction: str = "host") -> bytes:
    """The bytes of one side in a capture."""
    return b"".join(
        event.data
        for event in open_capture(path)
        if isinstance(event, Chunk) and event.direction == direction
    )
