"""Every call of the product that the bench measures, in one place: adapt it here alone."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy

import bilprov
from benchmarks.commands import bilprov_words
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.output.outputs import Output, Shown
from bilprov.analyzer.pipeline import BATCH, Pipeline
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.topics import CAR_STATE
from bilprov.spec.arrays.states import Known
from bilprov.spec.arrays.tables import request_tables
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol

_PART = 1 << 18  # bytes that are decoded at once, so that the arrays of a part fit into a cache


Columns = tuple[Any, dict[str, Any]]
"""One part's array of verdicts (places in `Outcome`), and an array of states for each variable."""


def decoded_columns(protocol: Protocol) -> Callable[[bytes], list[Columns]]:
    """The function from whole host frames to columns."""
    tables = request_tables(protocol)

    def decode(data: bytes) -> list[Columns]:
        buffer, at, columns = numpy.frombuffer(data, numpy.uint8), 0, []
        state = protocol.power_on
        while at < len(data):
            part = buffer[at : at + _PART]
            found = tables.cut(part, 0)
            known = Known(state, None)
            states = {
                name: tables.states.column(name, part, found.whole, known)
                for name in CAR_STATE.variables
            }
            columns.append((found.whole.verdict, states))
            state = tables.states.last(part, found.whole, known).state
            at += found.end or len(data)
        return columns

    return decode


def judged_columns(columns: list[Columns], protocol: Protocol) -> bytes:
    """The code of the response that is due to each frame."""
    codes = bytes(max(protocol.answers[outcome].code, 0) for outcome in Outcome).ljust(256, b"\0")
    return b"".join(verdict.tobytes() for verdict, _ in columns).translate(codes)


def decoded_records(path: Path) -> tuple[float, bytes]:
    """The time (s) that `bilprov.decode` takes for the file's bytes, the first call in a process.

    Beside it stand the codes of the responses that are due, worked out after the time was taken.
    """
    data, protocol = path.read_bytes(), bilprov.load_protocol()
    begun = time.perf_counter()
    records = bilprov.decode(data)
    took = time.perf_counter() - begun
    codes = {spec.name: code for code, spec in protocol.codes.items()}
    due = (getattr(record.value, "judgement", None) for record in records)
    return took, bytes(codes[name] for name in due if name is not None)


@contextmanager
def sniffing(path: Path, protocol: Protocol) -> Iterator[Callable[[Chunk], object]]:
    """What `sniff -w` does with each chunk that was read; nothing is shown."""
    decoder = StreamDecoder(protocol, skew=0)
    with Recorder(path, time.time_ns(), metadata(protocol)) as recorder:
        shown = Shown(Output())
        pipeline = Pipeline(decoder, shown, recorder, patience=BATCH)
        pipeline.events([Line(0, "open")])

        def take(chunk: Chunk) -> None:
            pipeline.events([chunk])
            pipeline.advance(chunk.t)

        yield take
        pipeline.finish()


def metadata(protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture of two taps, without its start."""
    return session_metadata(
        protocol,
        ports={"host": "bench", "device": "bench"},
        line=str(line_settings(protocol)),
        timeout=timeout_in_ns(protocol, None),
        skew=0,
        heard=BOTH,
    )


def browsed(path: Path) -> list[str]:
    """The command that shows a capture on the screen."""
    return bilprov_words("replay", str(path))


def statistics(path: Path) -> list[str]:
    """The command that prints a capture's statistics."""
    return bilprov_words("stats", str(path), "--json", "-")


def replayed(path: Path, start: float = 0.0) -> list[str]:
    """The command that prints a capture's frames from `start` (s) on, as fast as it goes."""
    more = ["--start", f"{start:.6f}"] if start else []
    return bilprov_words("replay", str(path), "--rate", "0", "--format", "jsonl", *more)


def sniffed(host: str, device: str, style: str, capture: Path | None = None) -> list[str]:
    """The command that listens to two lines; `style` is a format, or `quiet`."""
    shown = ["--quiet"] if style == "quiet" else ["--format", style]
    return bilprov_words("sniff", host, device, *(["-w", str(capture)] if capture else []), *shown)


def main() -> None:
    """Decode a file in this process, which has decoded nothing yet."""
    took, codes = decoded_records(Path(sys.argv[1]))
    json.dump([took, codes.hex()], sys.stdout)


if __name__ == "__main__":
    main()
