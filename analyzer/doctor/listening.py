"""What is found by listening to one or two taps for a moment: nothing is ever sent."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from shlex import quote

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.finding import Finding, Grade
from bilprov.analyzer.taps.sources import Events, Source
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.captures.text import printable, quantity
from bilprov.spec.protocol import Protocol

_TEXT = re.compile(rb"[\t\r\n\x20-\x7e]{8,}")  # as boards print while they boot
# What errors that a driver counts mean.
_MEANS = {
    "framing": "another baud rate or other stop bits are on the line; find the rate, give --baud",
    "parity": "the line has another parity; give --parity",
    "overrun": "bytes arrive faster than they are read; is the machine too busy?",
}
_LEAST_ANSWERS = 5  # of which it is told whether they fit
_FIT, _MISFIT = 0.8, 0.5  # shares of answers that are the expected ones
_OTHER: dict[Direction, Direction] = {"host": "device", "device": "host"}


def listened(source: Source, seconds: float, stopper: Stopper) -> Events:
    """Give what is heard on the taps within `seconds`, or until Ctrl-C or the end of all ports."""
    events: Events = []
    end = round(seconds * 1e9)
    while not stopper.stopped and not source.ended and (left := end - source.now()) > 0:
        events += source.poll(min(left / 1e9, 0.1), [stopper.fileno()])
    return events


def heard(
    protocol: Protocol, names: Mapping[str, str], events: Sequence[Chunk | Line], seconds: float
) -> Iterator[Finding]:
    """Yield what the events of `seconds` say of the line.

    `names` are those of the ports, by the direction that each hears: one or two.
    """
    data = {side: _said(events, side) for side in names}
    count = sum(map(len, data.values()))
    for event in events:
        if isinstance(event, Line) and event.event == "unplugged":
            last = printable(data[event.tap].decode("latin-1").strip())
            said = f"it sent {last!r}, then " if last else ""
            yield Finding("line", Grade.BLOCKS, said + event.detail)
    yield from _miscounted(names, events, count)
    if not count:
        why = "a device speaks only when it is asked" if len(names) == 1 else "does the host drive?"
        sentence = f"not a byte was heard in {seconds:.3g} s: {why}"
        yield Finding("traffic", Grade.UNSEEN, sentence)
        return
    for side, told in data.items():
        found = _TEXT.search(told)
        if found and len(found[0]) * 2 > len(told) and not _is_traffic(protocol, told):
            text = printable(found[0].decode("ascii").strip())
            sentence = f"{names[side]} carries text, which is another protocol: {text!r}"
            yield Finding("traffic", Grade.ADVICE, sentence)
            return
    if len(names) > 1:
        yield _wired(protocol, names, events, data)
    else:
        sentence = f"{quantity(count, 'byte')} came in {seconds:.3g} s"
        yield Finding("traffic", Grade.FINE, sentence)


def _is_traffic(protocol: Protocol, data: bytes) -> bool:
    """Whether most of the bytes are valid frames, some of which look like text too."""
    session = Session(protocol, heard=frozenset({"host"}))
    records = [*session.feed(Chunk(0, "host", data)), *session.finish()]
    frames = (record for record in records if isinstance(record, HostRecord))
    valid = sum(len(one.data) for one in frames if one.judgement and one.judgement.valid)
    return 2 * valid >= len(data)


def _said(events: Sequence[Chunk | Line], side: str) -> bytes:
    chunks = (event for event in events if isinstance(event, Chunk))
    return b"".join(chunk.data for chunk in chunks if chunk.direction == side)


def _miscounted(
    names: Mapping[str, str], events: Sequence[Chunk | Line], count: int
) -> Iterator[Finding]:
    """Errors that the driver has counted: framing errors mean another baud rate."""
    lines = [event for event in events if isinstance(event, Line)]
    for kind, means in _MEANS.items():
        errors = sum(int(line.detail.split()[0]) for line in lines if line.event == kind)
        if errors:
            counted = quantity(errors, f"{kind} error")
            sentence = f"the driver counted {counted} in {quantity(count, 'byte')}: {means}"
            (name, *others) = names.values()
            asks = kind == "framing" and not others
            command = f"bilprov ports {quote(name)} --ask --yes" if asks else ""
            yield Finding("line errors", Grade.BLOCKS, sentence, command)


def _wired(
    protocol: Protocol,
    names: Mapping[str, str],
    events: Sequence[Chunk | Line],
    data: Mapping[str, bytes],
) -> Finding:
    """Whether two taps are wired as they were named, by whose bytes answer whose."""
    chunks = [event for event in events if isinstance(event, Chunk)]
    codes = {spec.code for spec in protocol.responses}
    if data["host"] == data["device"] and not set(data["host"]) <= codes:
        sentence = "both taps hear the same bytes: they are on one wire, or the line is an echo"
        command = f"bilprov sniff --half-duplex {quote(names['host'])}"
        return Finding("taps", Grade.BLOCKS, sentence, command)
    straight, count = _fitting(protocol, chunks)
    turned, turned_count = _fitting(
        protocol, [Chunk(chunk.t, _OTHER[chunk.direction], chunk.data) for chunk in chunks]
    )
    if turned_count >= _LEAST_ANSWERS and turned >= _FIT and straight < _MISFIT:
        sentence = (
            f"the taps are swapped: read the other way round, {turned:.0%} of the answers are the "
            f"expected ones, this way {straight:.0%}; give them in the other order"
        )
        command = f"bilprov sniff {quote(names['device'])} {quote(names['host'])}"
        return Finding("taps", Grade.BLOCKS, sentence, command)
    if count < _LEAST_ANSWERS:
        heard_of = quantity(count, "answer")
        sentence = f"only {heard_of} came, too few to decide whether the taps are swapped"
        return Finding("taps", Grade.UNSEEN, sentence)
    if straight < _MISFIT:
        sentence = (
            f"{straight:.0%} of {count} answers are the expected ones, either way round: another "
            "baud rate, another protocol, or a device that errs"
        )
        return Finding("taps", Grade.ADVICE, sentence)
    return Finding("taps", Grade.FINE, f"{straight:.0%} of {count} answers are the expected ones")


def _fitting(protocol: Protocol, chunks: Sequence[Chunk]) -> tuple[float, int]:
    """The share of the device's bytes that are the expected answers, and how many bytes it sent."""
    session = Session(protocol, attached=True)
    records = [record for chunk in chunks for record in session.feed(chunk)]
    answers = [one for one in (*records, *session.finish()) if isinstance(one, DeviceRecord)]
    return sum(bool(one.agrees) for one in answers) / max(1, len(answers)), len(answers)
