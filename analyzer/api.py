"""The public functions of `from bilprov import ...` for bytes, captures and taps.

`protocol` is always the last argument: a grammar's name, its file, or a loaded one. It is the kit's
own unless given.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.session import SKEW, Session
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import Grammar, given_protocol, load_protocol
from bilprov.analyzer.replay.capture_decoding import (
    TEXT_BATCH,
    capture_protocol,
    opened_whole,
    said_of_other,
)
from bilprov.analyzer.taps.sources import Ports, opened_tap
from bilprov.analyzer.transport.line_settings import (
    LineSettings,
    line_settings,
    timeout_in_ns,
)
from bilprov.analyzer.transport.machine import Machine
from bilprov.captures.reader import open_verified
from bilprov.captures.schemas import Chunk, Direction
from bilprov.captures.topics import CarLook as Look  # noqa: F401  # handed on
from bilprov.spec import codec
from bilprov.spec import explain as explaining
from bilprov.spec.codec import Judgement
from bilprov.spec.explain import Explanation

PIECE = 1 << 16  # bytes that are decoded at once


def judge(frame: bytes, protocol: Grammar | None = None) -> Judgement:
    """Judge one frame as a conforming device does.

    Raises ValueError for no bytes, and for more bytes than the header announces.
    """
    return codec.judge(given_protocol(protocol), frame)


def encode(
    instruction: str, fields: Mapping[str, int] | None = None, protocol: Grammar | None = None
) -> bytes:
    """Encode an instruction as bytes, like `encode("LED", {"rgb": 5})`.

    Raises ValueError, in one sentence, for an unknown instruction or field, a missing field or a
    value out of its range.
    """
    return codec.build(given_protocol(protocol), instruction, fields)


def explain(
    data: bytes,
    direction: Direction = "host",
    protocol: Grammar | None = None,
    asked: bytes = b"",
) -> Explanation:
    """Explain every bit of the bytes, and what a conforming device answers and does.

    `asked` are the requests that a device's bytes answer, where they are known. Raises ValueError,
    in one sentence, for host bytes that are no frame, and for requests that are not answered.
    """
    protocol = given_protocol(protocol)
    if direction == "host":
        return explaining.explain(protocol, data)
    return explaining.explain_responses(protocol, data, explaining.requests_of(protocol, asked))


def decode(
    data: bytes, direction: Direction = "host", protocol: Grammar | None = None
) -> list[HostRecord | DeviceRecord]:
    """Decode host bytes into frames, or device bytes into responses.

    The bytes count as sent without a pause: all times are 0, and an incomplete last frame is
    reported as cut short.
    """
    decoder = StreamDecoder(given_protocol(protocol), heard=frozenset({direction}))
    batches: list[Batch] = []
    for at in range(0, len(data), PIECE):
        batches += decoder.feed([Chunk(0, direction, data[at : at + PIECE])])
    batches += decoder.finish()
    # One direction alone has neither line events nor missing answers.
    return [record for batch in batches for record in batch.records()]  # type: ignore[misc]


def read_capture(path: str | Path, protocol: Grammar | None = None) -> Iterator[Record]:
    """Decode a capture from its raw bytes and yield the records in order.

    Records are frames, answers, line events and anomalies. Unless a protocol is given, it is
    decoded by the grammar that it carries; of one that carries none, and was recorded with another
    grammar than the kit's own, a warning says so.

    Times are ns since the capture's start. Raises CaptureError, in one sentence, when the file
    cannot be read as a capture, and GrammarError for a grammar in it that cannot be used.
    """
    capture = open_verified(path)
    carried = capture_protocol([capture], load_protocol()) if protocol is None else None
    if carried and (other := said_of_other(capture, carried)):
        warnings.warn(other, stacklevel=2)
    opened = opened_whole(capture, carried or given_protocol(protocol))
    for batch in opened.decoded(largest=TEXT_BATCH):
        yield from batch.records()


_LONGEST_WAIT = 0.2  # s, so that Ctrl-C is never held up


def sniff(
    host: str,
    device: str | None = None,
    *,
    half_duplex: bool = False,
    settings: LineSettings | None = None,
    protocol: Grammar | None = None,
) -> Iterator[Record]:
    """Listen to two taps, `host` and `device` (or to the host alone), and yield decoded records.

    With `half_duplex` `host` is one wire that has both directions, as RS-485. Ports are paths or
    pyserial URLs; `settings` are the protocol's own line unless given. The iterator ends when both
    lines are unplugged, and closes the ports when it is closed. Times are ns since the start.
    Raises LinkError for a port that cannot be opened, ValueError where both names mean one line,
    and for a `device` beside a wire with both directions.
    """
    protocol = given_protocol(protocol)
    settings = settings or line_settings(protocol)
    if half_duplex and device is not None:
        raise ValueError(f"one wire has both directions: leave out {device}, or half_duplex")
    given = Ports(half_duplex=host) if half_duplex else Ports(host, device)
    timeout = timeout_in_ns(protocol, None)
    with opened_tap(given, settings, protocol, timeout) as taps:
        timeout = max(timeout, Machine().least_pause(*taps.names.values()))
        skew = 0 if taps.one_clock else SKEW
        session = Session(
            protocol, timeout=timeout, heard=taps.heard, skew=skew, attached=taps.attached
        )
        while not taps.ended:
            now, due = taps.now(), session.deadline
            wait = _LONGEST_WAIT if due is None else min(_LONGEST_WAIT, max(0, due - now) / 1e9)
            for event in taps.poll(wait):
                yield from session.feed(event)
            yield from session.advance(taps.seen)
        for event in taps.rest():
            yield from session.feed(event)
        yield from session.finish(taps.now())
