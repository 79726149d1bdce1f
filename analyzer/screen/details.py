"""What is known about one record, as lines of a tree: bits and their meaning, answer, times, state.

The meanings are those of `spec.explain`. The pane escapes control characters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
)
from bilprov.analyzer.output.text_lines import state_words
from bilprov.captures.text import printable
from bilprov.spec.codec import spaced
from bilprov.spec.explain import BitGroup, explain, explain_responses
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Detail:
    """One line: a `label` and what it says, at a depth of 0 (a heading) or 1.

    `group` are the bits that it is about; `bad` marks what is faulty.
    """

    depth: int
    label: str
    text: str = ""
    group: BitGroup | None = None
    bad: bool = False


def details(protocol: Protocol, record: Record) -> tuple[Detail, ...]:
    """The lines of a record."""
    if isinstance(record, HostRecord):
        lines = _host(protocol, record)
    elif isinstance(record, DeviceRecord):
        lines = _device(protocol, record)
    elif isinstance(record, LineRecord):
        lines = _line(record)
    else:
        lines = iter([Detail(0, "Missing", record.fault.kind, bad=True)])
    return *lines, *_faults(record), *_times(record), *_state(record)


def record_bytes(record: Record) -> bytes:
    """The bytes of a record, of which its bit groups speak; b"" where it has none."""
    if isinstance(record, HostRecord):
        return record.data
    return bytes([record.byte]) if isinstance(record, DeviceRecord) else b""


def covers(group: BitGroup, byte: int, bit: int) -> bool:
    """Whether a bit (counted from 0 at the right end) of a byte of the record is in a group."""
    place = bit + 8 * (group.byte + group.size - 1 - byte)
    return group.byte <= byte < group.byte + group.size and group.low <= place <= group.high


def bit_picture(group: BitGroup) -> str:
    """The bits of a group in their places, dots for the others: `.... 0001`."""
    width = 8 * group.size
    at = width - 1 - group.high
    bits = "." * at + group.bits + "." * group.low
    return " ".join(bits[low : low + 4] for low in range(0, width, 4))


def _host(protocol: Protocol, record: HostRecord) -> Iterator[Detail]:
    if record.judgement is None:
        yield Detail(0, "Garbage", spaced(record.data), bad=True)
        return
    frame = explain(protocol, record.data).frames[0]
    yield Detail(0, "Instruction", record.words, bad=not frame.judgement.valid)
    for group in frame.groups:
        yield _bits(group)
    yield Detail(0, "Device", f"answers {frame.answer}")
    yield Detail(1, "does", frame.action)
    for variable, value in frame.changes:
        yield Detail(1, "sets", f"{variable} to {value}")
    if frame.keeps:
        yield Detail(1, "keeps", ", ".join(frame.keeps))
    if frame.nearest:
        yield Detail(0, "Meant", f"{spaced(frame.nearest.frame)}  {frame.nearest.describe()}")
        for difference in frame.differences:
            yield Detail(1, "as", difference)
    if frame.judgement.clause:
        yield Detail(0, "Document", frame.judgement.clause)
    for reading in frame.readings:
        yield Detail(1, reading.id, reading.default)
    for erratum in frame.errata:
        yield Detail(1, erratum.id, erratum.correction)


def _device(protocol: Protocol, record: DeviceRecord) -> Iterator[Detail]:
    response = explain_responses(protocol, bytes([record.byte])).responses[0]
    yield Detail(0, "Response", record.words, bad=response.group.fault)
    yield _bits(response.group)
    yield Detail(1, "means", response.meaning)
    if record.answered is not None:
        answered = record.answered
        yield Detail(0, "Answers", f"{spaced(answered.frame)}  {answered.describe()}")
        expected = f"{answered.response.name}, {'which came' if record.agrees else 'but this came'}"
        yield Detail(1, "expected", expected, bad=record.agrees is False)
        yield Detail(1, "number", str(record.instruction))
    if record.latency is not None:
        yield Detail(0, "Latency", f"{record.latency / 1e6:.3f} ms")
    yield Detail(0, "Document", response.clause)


def _line(record: LineRecord) -> Iterator[Detail]:
    line = record.value
    yield Detail(0, "Line", line.event, bad=bool(record.faults))
    if line.tap:
        yield Detail(1, "tap", line.tap)
    if line.detail:
        yield Detail(1, "detail", printable(line.detail))


def _bits(group: BitGroup) -> Detail:
    label = f"{bit_picture(group)}  {group.name}"
    return Detail(1, label, f"{group.value}  {group.meaning}", group, group.fault)


def _faults(record: Record) -> Iterator[Detail]:
    for fault in record.faults:
        yield Detail(0, "Fault", fault.kind, bad=True)
        yield Detail(1, "because", fault.reason, bad=True)


def _times(record: Record) -> Iterator[Detail]:
    yield Detail(0, "Time", f"{record.t / 1e9:.9f} s")
    if isinstance(record, HostRecord):
        yield Detail(1, "last byte", f"{(record.end - record.t) / 1e6:.3f} ms later")
        if record.sequence is not None:
            yield Detail(1, "number", str(record.sequence))
    if isinstance(record, FaultRecord) and record.fault.instruction is not None:
        yield Detail(1, "number", str(record.fault.instruction))


def _state(record: Record) -> Iterator[Detail]:
    yield Detail(0, "Predicted", state_words(record.state))
    for variable in record.state.__struct_fields__:
        value = getattr(record.state, variable)
        yield Detail(1, variable, str(value).lower() if isinstance(value, bool) else str(value))
