r"""Converts records to JSON lines, which `--format jsonl` of sniff, replay and decode prints.

Each line is one object, always with these keys in this order. A key that does not apply is null
(`fields` is {}):

- `t`: seconds since the start: the time of the first byte, or for a fault the time it was found.
- `direction`: `host` or `device`; null where a gap or a fault belongs to neither.
- `kind`: `instruction`, `response`, `truncated`, `garbage`, `gap` (bytes are known to be lost), and
  `fault` for an anomaly without bytes of its own, such as a missing answer or a break on the line.
- `hex`: the bytes, like `81 05`.
- `name`: the name of the instruction or the response, null for an unused one; for a fault its kind.
- `fields`: the decoded data, `{"rgb": 5}`.
- `judgement`: the response that a conforming device gives: to this instruction, or to the one that
  this response answers.
- `reason`: the reason for the judgement or the fault, in words; may be empty.
- `latency`: seconds from the instruction's last byte to this response; negative where two taps
  stamped it earlier.
- `state`: the motion state that the instructions so far predict: `motion`, `speed`, `steering`
  (right positive), `led`, `moving`.
- `sequence`: the number of the instruction, counted from 0 (whole and truncated ones).
- `answers`: the `sequence` of the instruction that this response answers.
- `agrees`: whether the response is the expected one.
- `faults`: the kinds of the line's anomalies: `faulty instruction`, `truncated`, `garbage`,
  `disagreeing`, `unused code`, `unsolicited`, `unanswered`, `slow`, `early`, `out of step`,
  `lost bytes`, and line events (`break`, `parity` ...). Those of severity info (`early` within the
  skew of two taps, a banner before the first instruction) appear in `reason` only.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from bilprov.analyzer.decode.per_frame import PerFrame
from bilprov.analyzer.decode.records import (
    Anomaly,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    Record,
    serious_faults,
)
from bilprov.captures.schemas import State
from bilprov.captures.text import printable


class JsonLine(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """One JSON line; the module's docstring explains the keys."""

    t: float
    direction: str | None = None
    kind: str
    hex: str = ""
    name: str | None = None
    fields: dict[str, int] = {}
    judgement: str | None = None
    reason: str
    latency: float | None = None
    state: State
    sequence: int | None = None
    answers: int | None = None
    agrees: bool | None = None
    faults: tuple[str, ...] = ()


encode = msgspec.json.Encoder().encode
encode_lines = msgspec.json.Encoder().encode_lines


def json_line(record: Record) -> JsonLine | None:
    """Convert a record to a line; None for a line event without an anomaly."""
    if isinstance(record, HostRecord):
        line = _frame_line(record)
        return replace(line, t=record.t / 1e9, state=record.state, sequence=record.sequence)
    if isinstance(record, DeviceRecord):
        return _device_line(record)
    if isinstance(record, FaultRecord):
        return _fault_line(record.fault, record)
    if not record.faults:
        return None
    fault, direction = record.faults[0], record.value.tap or None
    return _fault_line(fault, record, "gap" if record.lost else "fault", direction)


def _kinds(record: Record) -> tuple[str, ...]:
    return tuple(fault.kind for fault in serious_faults(record))


@PerFrame
def _frame_line(record: HostRecord) -> JsonLine:
    judgement = record.judgement
    spec = judgement.instruction if judgement else None
    return JsonLine(
        t=record.t / 1e9,
        direction="host",
        kind=record.kind,
        hex=record.hex,
        name=spec.name if spec else None,
        fields=dict(judgement.fields) if judgement else {},
        judgement=judgement.response.name if judgement else None,
        reason=record.reason,
        state=record.state,
        sequence=record.sequence,
        faults=_kinds(record),
    )


def _device_line(record: DeviceRecord) -> JsonLine:
    return JsonLine(
        t=record.t / 1e9,
        direction="device",
        kind="response",
        hex=record.hex,
        name=record.answer.name if record.answer else None,
        judgement=record.answered.response.name if record.answered else None,
        reason=record.reason,
        latency=None if record.latency is None else record.latency / 1e9,
        state=record.state,
        answers=record.instruction,
        agrees=record.agrees,
        faults=_kinds(record) if record.faults else (),
    )


def _fault_line(
    fault: Anomaly, record: Record, kind: str = "fault", direction: str | None = None
) -> JsonLine:
    return JsonLine(
        t=fault.t / 1e9,
        direction=direction,
        kind=kind,
        name=printable(fault.kind) if kind == "fault" else None,
        reason=fault.reason,
        state=record.state,
        sequence=fault.instruction,
        faults=_kinds(record),
    )
