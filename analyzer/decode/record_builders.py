"""Builds records from frames and device bytes, their judgements and their anomalies."""

from __future__ import annotations

from bilprov.analyzer.decode.anomalies import AnswerCheck
from bilprov.analyzer.decode.pairing import Held, Waiting
from bilprov.analyzer.decode.records import Anomaly, DeviceRecord, HostRecord
from bilprov.captures.schemas import Instruction, Response, State
from bilprov.spec.codec import Judgement, spaced
from bilprov.spec.framing import Framed
from bilprov.spec.protocol import Protocol


def frame_record(
    framed: Framed,
    judgement: Judgement,
    sequence: int,
    state: State,
    faults: tuple[Anomaly, ...],
) -> HostRecord:
    """The record of a frame, whole or cut short."""
    value = Instruction(
        t=framed.start,
        end=framed.end,
        kind=framed.kind,
        hex=spaced(framed.data),
        sequence=sequence,
        id=judgement.id,
        name=judgement.instruction.name if judgement.instruction else None,
        length=judgement.length,
        fields=dict(judgement.fields),
        judgement=judgement.response.name,
        reason=judgement.reason,
    )
    return HostRecord(value, framed.data, judgement, state, faults)


def garbage_record(
    framed: Framed, reason: str, state: State, faults: tuple[Anomaly, ...]
) -> HostRecord:
    """The record of host bytes that belong to no frame; `reason` says why."""
    value = Instruction(
        t=framed.start,
        end=framed.end,
        kind="garbage",
        hex=spaced(framed.data),
        sequence=None,
        id=None,
        name=None,
        length=None,
        fields={},
        judgement=None,
        reason=reason,
    )
    return HostRecord(value, framed.data, None, state, faults)


def answer_record(
    protocol: Protocol,
    held: Held,
    waiting: Waiting | None,
    verdict: AnswerCheck,
    state: State,
) -> DeviceRecord:
    """The record of a device byte that answers `waiting` (None: it answers no instruction)."""
    answer = protocol.codes.get(held.byte)
    value = Response(
        t=held.t,
        hex=f"{held.byte:02x}",
        byte=held.byte,
        name=answer.name if answer else None,
        instruction=waiting.sequence if waiting else None,
        latency=held.t - waiting.end if waiting else None,
        agrees=verdict.agrees,
        reason="; ".join(fault.reason for fault in verdict.faults),
    )
    return DeviceRecord(
        value, answer, waiting.judgement if waiting else None, state, verdict.faults
    )
