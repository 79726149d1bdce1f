r"""Records as JSON lines: what `--format jsonl` of sniff, replay and decode prints.

One object a line, always with these keys in this order; what does not apply is null (`fields` {}):

- `t`: seconds since the start; of the first byte, of a fault when it was known.
- `direction`: `host` or `device`; null where a gap or a fault belongs to neither.
- `kind`: `instruction`, `response`, `truncated`, `garbage`, `gap` (bytes are known to be lost), and
  `fault` for what no frame stands for: an answer that never came, a break on the line.
- `hex`: the bytes, like `81 05`.
- `name`: of the instruction or the response, null where it is unused; of a fault its kind.
- `fields`: the decoded data, `{"rgb": 5}`.
- `judgement`: the response that a conforming device gives: to this instruction, or to the one that
  this response answers.
- `reason`: why, in words; empty where there is nothing to say.
- `latency`: seconds from the instruction's last byte to this response; negative where two taps
  stamped it earlier.
- `state`: what the instructions so far predict: `motion`, `speed`, `steering` (right positive),
  `led`, `moving`.
- `sequence`: counts instructions (whole and truncated) from 0.
- `answers`: the `sequence` of the instruction that this response answers.
- `agrees`: whether the response is the expected one.
- `faults`: the kinds of fault that this line tells of: `faulty instruction`, `truncated`,
  `garbage`, `disagreeing`, `unused code`, `unsolicited`, `unanswered`, `slow`, `early`,
  `out of step`, `lost bytes`, and line events (`break`, `parity` ...). What is a matter of
  uncertain times (`early` within the skew of two taps, a banner before the first instruction)
  stands in `reason` alone.
"""

from __future__ import annotations

import msgspec

from analyzer.decode.records import (
    DeviceRecord,
    Fault,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    Severity,
    faults_of,
)
from captures.errors import shown
from captures.schemas import State


class JsonLine(msgspec.Struct, frozen=True):
    """One line; the module's docstring says what the keys mean."""

    t: float
    direction: str | None
    kind: str
    hex: str
    name: str | None
    fields: dict[str, int]
    judgement: str | None
    reason: str
    latency: float | None
    state: State
    sequence: int | None = None
    answers: int | None = None
    agrees: bool | None = None
    faults: tuple[str, ...] = ()


encode = msgspec.json.Encoder().encode


def json_line(record: Record) -> JsonLine | None:
    """The record as a line; None for a line event that is neither a loss nor a fault."""
    if isinstance(record, HostRecord):
        return _host_line(record)
    if isinstance(record, DeviceRecord):
        return _device_line(record)
    if isinstance(record, FaultRecord):
        return _fault_line(record.fault, record.state, "fault", None)
    if not record.faults:
        return None
    kind = "gap" if record.lost else "fault"
    return _fault_line(record.faults[0], record.state, kind, record)


def _kinds(record: Record) -> tuple[str, ...]:
    """The faults that count; what only makes times uncertain is in `reason` alone."""
    return tuple(f.kind for f in faults_of(record) if f.severity > Severity.INFO)


def _host_line(record: HostRecord) -> JsonLine:
    value = record.value
    return JsonLine(
        t=value.t / 1e9,
        direction="host",
        kind=value.kind,
        hex=value.hex,
        name=value.name,
        fields=value.fields,
        judgement=value.judgement,
        reason=value.reason,
        latency=None,
        state=record.state,
        sequence=value.sequence,
        faults=_kinds(record) if record.faults else (),
    )


def _device_line(record: DeviceRecord) -> JsonLine:
    value = record.value
    return JsonLine(
        t=value.t / 1e9,
        direction="device",
        kind="response",
        hex=value.hex,
        name=value.name,
        fields={},
        judgement=record.answered.response.name if record.answered else None,
        reason=value.reason,
        latency=None if value.latency is None else value.latency / 1e9,
        state=record.state,
        answers=value.instruction,
        agrees=value.agrees,
        faults=_kinds(record) if record.faults else (),
    )


def _fault_line(fault: Fault, state: State, kind: str, line: LineRecord | None) -> JsonLine:
    return JsonLine(
        t=fault.t / 1e9,
        direction=(line.value.tap or None) if line else None,
        kind=kind,
        hex="",
        name=shown(fault.kind) if kind == "fault" else None,
        fields={},
        judgement=None,
        reason=fault.reason,
        latency=None,
        state=state,
        sequence=fault.instruction,
        faults=(fault.kind,),
    )
