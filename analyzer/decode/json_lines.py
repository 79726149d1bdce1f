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
- `state`: the state that the instructions so far predict, as the grammar declares it: `motion`,
  `speed`, `steering` (right positive), `led`. `moving` tells that the device is not at rest, where
  the grammar says when it is. A value that is not known is null.
- `sequence`: the number of the instruction, counted from 0 (whole and truncated ones).
- `answers`: the `sequence` of the instruction that this response answers.
- `agrees`: whether the response is the expected one.
- `faults`: the kinds of the line's anomalies: `faulty instruction`, `truncated`, `garbage`,
  `disagreeing`, `unused code`, `unsolicited`, `unanswered`, `slow`, `early`, `out of step`,
  `lost bytes`, and line events (`break`, `parity` ...). Those of severity info (`early` within the
  skew of two taps, a banner before the first instruction, `uncertain`) appear in `reason` only.

Where a grammar's frames are more than a header byte and data, there are two keys more:

- `outcome`: of an instruction, or of the one that this response answers: `valid`, `unknown-id`,
  `bad-data`, `too-many`, `too-few`, `truncated`, `bad-checksum`, `bad-sync`, `other-address`.
- `address`: who is meant, or who answers; where frames have an address.

A line whose bytes may not be one frame, or one answer, has one key more, `uncertain`: true. So it
is where only silence tells the end, and before it is clear where frames begin; `reason` says which.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    PerFrame,
    Record,
    serious_kinds,
)
from bilprov.captures.text import printable
from bilprov.spec.codec import Judgement
from bilprov.spec.data import plain_values
from bilprov.spec.fields import Outcome
from bilprov.spec.state import State


class JsonLine(msgspec.Struct, frozen=True, gc=False):
    """One JSON line; the module's docstring explains the keys."""

    t: float
    direction: str | None
    kind: str
    hex: str
    name: str | None
    fields: dict[str, Any]
    judgement: str | None
    reason: str
    latency: float | None
    state: State
    sequence: int | None = None
    answers: int | None = None
    agrees: bool | None = None
    faults: tuple[str, ...] = ()
    outcome: str | UnsetType = UNSET
    address: int | UnsetType = UNSET
    uncertain: bool | UnsetType = UNSET


encode = msgspec.json.Encoder().encode
encode_lines = msgspec.json.Encoder().encode_lines


def json_line(record: Record) -> JsonLine | None:
    """Convert a record to a line; None for a line event without an anomaly."""
    lines = json_lines([record])
    return lines[0] if lines else None


def json_lines(records: Iterable[Record]) -> list[JsonLine]:
    """Convert records to lines; a line event without an anomaly has none."""
    lines: list[JsonLine] = []
    add = lines.append
    for record in records:  # in one loop: a call for each record would take a third more time
        if isinstance(record, HostRecord):
            line, kind = _frame_line(record), record.kind
            t, state, sequence = record.t / 1e9, record.state, record.sequence
            add(replace(line, t=t, kind=kind, state=state, sequence=sequence))
        elif isinstance(record, DeviceRecord):
            answered, latency, reply = record.answered, record.latency, record.reply
            add(
                JsonLine(
                    record.t / 1e9,
                    "device",
                    "response",
                    _HEX[record.byte] if reply is None else record.hex,
                    record.name if reply or not record.answer else record.answer.name,
                    NO_FIELDS if reply is None else plain_values(reply.values),
                    answered.expected if answered else None,
                    record.reason if record.faults else "",
                    None if latency is None else latency / 1e9,
                    record.state,
                    None,
                    record.instruction,
                    record.agrees,
                    serious_kinds(record) if record.faults else (),
                    UNSET if reply is None or answered is None else _outcome(answered),
                    _known(reply.address) if reply else UNSET,
                    (record.faults and record.uncertain) or UNSET,
                )
            )
        elif record.faults:
            add(_fault_line(record))
    return lines


OUTCOME_WORDS = (*(one.name.lower().replace("_", "-") for one in Outcome), "truncated")
"""The words for the outcomes in their order, and for a frame that was cut short."""

_PLACE = {outcome: place for place, outcome in enumerate(Outcome)}


def _outcome(judgement: Judgement) -> str:
    return OUTCOME_WORDS[-1 if judgement.truncated else _PLACE[judgement.outcome]]


def _known(value: int | None) -> int | UnsetType:
    return UNSET if value is None else value


NO_FIELDS: dict[str, Any] = {}
_HEX = [f"{byte:02x}" for byte in range(256)]


_EMPTY = JsonLine(0.0, None, "fault", "", None, NO_FIELDS, None, "", None, State())


@PerFrame
def _frame_line(record: HostRecord) -> JsonLine:
    """The line of a frame, which is the same wherever it comes but for its time and its place."""
    judgement = record.judgement
    line = replace(
        _EMPTY,
        direction="host",
        hex=record.hex,
        reason=record.reason,
        faults=serious_kinds(record),
        uncertain=record.uncertain or UNSET,
    )
    if judgement is None:
        return line
    return replace(
        line,
        name=judgement.instruction.name if judgement.instruction else None,
        fields=plain_values(judgement.values),
        judgement=judgement.expected,
        outcome=_outcome(judgement) if judgement.framed else UNSET,
        address=_known(judgement.address),
    )


def _fault_line(record: LineRecord | FaultRecord) -> JsonLine:
    """The line of an anomaly without bytes of its own."""
    fault, kind, direction = record.faults[0], "fault", None
    if isinstance(record, LineRecord):
        kind, direction = "gap" if record.lost else "fault", record.value.tap or None
    return replace(
        _EMPTY,
        t=fault.t / 1e9,
        direction=direction,
        kind=kind,
        name=printable(fault.kind) if kind == "fault" else None,
        reason=fault.reason,
        state=record.state,
        sequence=fault.instruction,
        faults=serious_kinds(record),
    )
