"""Exports captures as pcapng, and reads such files: by a small reader of its own, and by tshark."""

from __future__ import annotations

import io
import shutil
import struct
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from bilprov.analyzer.export.pcapng import write_pcapng
from bilprov.analyzer.export.rows import Chosen
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.grammar_file import dissector_program
from bilprov.analyzer.output.outputs import Window
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.emit.python import snake_case
from bilprov.spec.emit.wireshark import lua_dissector
from bilprov.spec.protocol import Protocol
from tests.support.captures import about, write_capture

WALL = 1_790_000_000_123_456_789
PATIENCE = 60.0  # s
ALWAYS = Window()


class Packet(NamedTuple):
    """A packet of a pcapng file: wall clock (ns), and what the link type's header says."""

    wall: int
    interface: int
    seconds: int
    microseconds: int
    event: int
    lines: int
    footer: int
    data: bytes
    comment: str


def capture_of(
    path: Path, protocol: Protocol, events: Iterable[Chunk | Line], **metadata: str
) -> Path:
    """A capture of these events, in which the first byte of the host is a header."""
    line = {"port_host": "/dev/ttyUSB0", "port_device": "/dev/ttyUSB1", "line": "9600 8E1"}
    return write_capture(path, events, about(protocol) | line | metadata, WALL)


def exported(
    path: Path, protocol: Protocol, expression: str = "", window: Window = ALWAYS
) -> bytes:
    """The capture as pcapng."""
    test = compile_filter(expression, protocol) if expression else None
    stream = io.BytesIO()
    capture = open_capture(path)
    write_pcapng(Chosen(capture, protocol, test, window, lambda more: None), stream)
    return stream.getvalue()


def blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The blocks of a pcapng file in little-endian order: type and body."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        assert size % 4 == 0
        assert struct.unpack_from("<I", data, at + size - 4)[0] == size
        yield kind, data[at + 8 : at + size - 4]
        at += size


def options(data: bytes) -> dict[int, bytes]:
    """The options at the end of a block, by code."""
    found: dict[int, bytes] = {}
    at = 0
    while at < len(data):
        code, size = struct.unpack_from("<HH", data, at)
        if not code:
            assert len(data) == at + 4
            break
        found[code] = data[at + 4 : at + 4 + size]
        at += 4 + size + -size % 4
    return found


def packets(data: bytes) -> list[Packet]:
    """The packets of a pcapng file."""
    found = []
    for kind, body in blocks(data):
        if kind == 6:
            interface, high, low, size, whole = struct.unpack_from("<5I", body)
            assert size == whole
            header = struct.unpack_from(">IIBBH", body, 20)
            comment = options(body[20 + size + -size % 4 :]).get(1, b"").decode()
            found.append(
                Packet(high << 32 | low, interface, *header, body[32 : 20 + size], comment)
            )
    return found


def reads(events: Iterable[Chunk]) -> bytes:
    """A pcapng file with a packet for each chunk, as another program may write it."""
    section = struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)
    interface = struct.pack("<HHIHHB3xI", 250, 0, 0, 9, 1, 9, 0)  # times in ns
    made = [(0x0A0D0D0A, section), (1, interface)]
    for chunk in events:
        t = WALL + chunk.t
        event = 1 if chunk.direction == "host" else 2
        header = struct.pack(">IIBBH", t // 10**9, t // 1000 % 10**6, event, 0, 0)
        size = len(header + chunk.data)
        front = struct.pack("<5I", 0, t >> 32, t & 0xFFFFFFFF, size, size)
        made.append((6, front + header + chunk.data + bytes(-size % 4)))
    return b"".join(
        struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)
        for kind, body in made
    )


class Tshark:
    """tshark with the dissector of a protocol, in a folder; where it is absent, the test skips."""

    def __init__(self, folder: Path, protocol: Protocol) -> None:
        if shutil.which("tshark") is None:
            pytest.skip("no tshark: apt-get install tshark")
        self._folder = folder
        self.word = snake_case(protocol.name, "x_")
        self._script = folder / "dissector.lua"
        self._script.write_text(lua_dissector(protocol, 20, dissector_program()), encoding="utf-8")

    def __call__(self, data: bytes, *options: str) -> str:
        """What it prints about a pcapng file, in two passes."""
        file = self._folder / "exported.pcapng"
        file.write_bytes(data)
        done = subprocess.run(
            ["tshark", "-2", "-n", "-r", file, "-X", f"lua_script:{self._script}", *options],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "Lua" not in done.stderr, done.stderr
        return done.stdout

    def rows(self, data: bytes, *fields: str) -> list[dict[str, str]]:
        """The fields of each packet, several values of one field separated by a bar."""
        asked = [part for name in fields for part in ("-e", name)]
        form = ["-E", "separator=/t", "-E", "aggregator=|", "-E", "occurrence=a"]
        text = self(data, "-T", "fields", *form, *asked)
        return [dict(zip(fields, line.split("\t"), strict=True)) for line in text.split("\n")[:-1]]
