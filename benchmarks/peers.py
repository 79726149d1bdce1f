"""What bilprov is measured beside: construct interpreted, and the plain mcap library.

Each does the same work on the same bytes as a program would that somebody writes in an afternoon
with that library; none of it is made slow on purpose.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from construct import ConstructError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from bilprov.captures.schemas import Chunk
from bilprov.captures.topics import DEVICE_RAW, HOST_RAW, METADATA_NAME
from bilprov.spec.fields import From, Outcome
from bilprov.spec.protocol import Protocol


class Parsed(NamedTuple):
    """One frame as construct has parsed it; `fields` is None where it is faulty."""

    data: bytes
    id: int
    code: int
    fields: dict[str, int] | None


class Construct:
    """The grammar's own construct objects, interpreted: one FRAME.parse_stream for each frame."""

    def __init__(self, protocol: Protocol) -> None:
        self._space: dict[str, Any] = {"__name__": "grammar"}
        exec(compile(protocol.source, protocol.origin, "exec", dont_inherit=True), self._space)
        answers: dict[int, Any] = self._space["RESPONSE"].answers
        self._codes = {answer.outcome: code for code, answer in answers.items()}
        instructions = self._space["INSTRUCTIONS"]
        self._lengths = {identity: one.sizeof() for identity, one in instructions.items()}
        self._effects = {identity: one.subcon.effect for identity, one in instructions.items()}
        self.state: dict[str, str | int] = dict(self._space["POWER_ON"].values)

    def frames(self, data: bytes) -> Iterator[Parsed]:
        """Yield the whole frames of data, and keep `state`."""
        frame_of, header_of = self._space["FRAME"].parse_stream, self._space["HEADER"].parse
        stream, at = BytesIO(data), 0
        while at < len(data):
            stream.seek(at)
            try:
                frame = frame_of(stream)
                header, fields = frame.header, frame.data
            except ConstructError:
                header, fields = header_of(data[at : at + 1]), None
            end = at + 1 + header.length
            if end > len(data):
                return
            code = self._code(header.id, header.length, fields is not None)
            if code == self._codes[Outcome.VALID]:
                values = {name: value for name, value in fields.items() if name != "_io"}
                self._apply(self._effects[header.id], values)
            else:
                values = None
                self._apply(self._space["FAULTY"], {})
            yield Parsed(data[at:end], header.id, code, values)
            at = end

    def parse(self, frames: Iterable[bytes]) -> None:
        """Parse each frame, and do nothing with it: the least that construct takes."""
        parse = self._space["FRAME"].parse
        for frame in frames:
            with suppress(ConstructError):
                parse(frame)

    def response(self, byte: int) -> str:
        """The name of a response byte."""
        return str(self._space["RESPONSE"].parse(bytes([byte])))

    def _code(self, identity: int, length: int, parsed: bool) -> int:
        takes = self._lengths.get(identity)
        if takes is None:
            return self._codes[Outcome.UNKNOWN_ID]
        if length != takes:
            return self._codes[Outcome.TOO_MANY if length > takes else Outcome.TOO_FEW]
        return self._codes[Outcome.VALID if parsed else Outcome.BAD_DATA]

    def _apply(self, effect: Any, fields: dict[str, int]) -> None:
        for name, value in effect.values.items():
            if isinstance(value, From):
                value = fields[value.field] * value.factor
            self.state[name] = value


def frame_json(construct: Construct, frame: Parsed, t: int, answer: int | None) -> bytes:
    """One frame and its answer as a JSON message."""
    told = {
        "t": t,
        "hex": frame.data.hex(" "),
        "id": frame.id,
        "fields": frame.fields,
        "judgement": construct.response(frame.code),
        "answer": None if answer is None else construct.response(answer),
        "state": construct.state,
    }
    return json.dumps(told).encode()


class PlainWriter:
    """An MCAP file by the mcap library alone; a context manager.

    `about` becomes its metadata record, and a chunk has `size` bytes before it is compressed.
    """

    def __init__(
        self, path: Path, about: Mapping[str, str] | None = None, size: int = 1 << 20
    ) -> None:
        self._file = path.open("xb")
        self._mcap = Writer(self._file, chunk_size=size, compression=CompressionType.ZSTD)
        self._mcap.start()
        if about:
            self._mcap.add_metadata(METADATA_NAME, dict(about))
        schema = self._mcap.register_schema("frame", "jsonschema", b'{"type": "object"}')
        self._channels = {
            "frame": self._mcap.register_channel("/frame", "json", schema),
            "host": self._mcap.register_channel(HOST_RAW, "application/octet-stream", 0),
            "device": self._mcap.register_channel(DEVICE_RAW, "application/octet-stream", 0),
        }

    def __enter__(self) -> PlainWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def write(self, channel: str, t: int, data: bytes) -> None:
        """Write a message at t (ns)."""
        self._mcap.add_message(self._channels[channel], t, data, t)


def json_written(path: Path, construct: Construct, chunks: Iterable[Chunk]) -> int:
    """Write one JSON message for each frame with its answer; returns how many frames."""
    frames, held = 0, b""
    waiting: list[Parsed] = []
    with PlainWriter(path) as file:
        for chunk in chunks:
            if chunk.direction == "host":
                data = held + chunk.data
                waiting += construct.frames(data)
                held = data[sum(len(frame.data) for frame in waiting) :]
                continue
            for frame, answer in zip(waiting, chunk.data, strict=True):
                file.write("frame", chunk.t, frame_json(construct, frame, chunk.t, answer))
            frames += len(waiting)
            waiting = []
    return frames


def construct_replayed(
    path: Path, construct: Construct, start: int, most: int, out: Any = None
) -> int:
    """Decode up to `most` host frames of a capture from `start` (ns) on, where a frame begins.

    The mcap library's own reader reads it. With `out`, write each as a JSON line. Returns how many
    there were.
    """
    frames, held = 0, b""
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=[HOST_RAW], starting_at=start):
            data, used = held + message.data, 0
            for frame in construct.frames(data):
                used += len(frame.data)
                frames += 1
                if out is not None:
                    out.write(frame_json(construct, frame, 0, None) + b"\n")
            held = data[used:]
            if frames >= most:
                break
    return frames
