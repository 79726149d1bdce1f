"""The records that a session decodes: a frozen value per frame, device byte, event and anomaly.

All times are integers in nanoseconds since the session's start; `t_ns` and `latency_ns` are the
same as `t` and `latency`, which in JSON lines and CSV are seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Generic, TypeAlias, TypeVar

import msgspec

from bilprov.captures.schemas import (
    FramedInstruction,
    FramedResponse,
    Instruction,
    Line,
    Look,
    Response,
    Timed,
    look_class,
)
from bilprov.captures.topics import Shapes
from bilprov.spec.codec import Judgement
from bilprov.spec.data import plain_values
from bilprov.spec.framing import Kind
from bilprov.spec.protocol import Protocol, ResponseSpec
from bilprov.spec.replies import Reply
from bilprov.spec.state import State

UNCERTAIN = "uncertain"
"""The kind of the anomaly of bytes that may not be one frame, or one answer."""


class Severity(IntEnum):
    """The severity of an anomaly; the numbers are those of Foxglove's log levels."""

    INFO = 2
    WARNING = 3
    ERROR = 4


class Anomaly(Timed, frozen=True, gc=False):
    """An anomaly in the traffic: its time `t` (ns), kind, severity, and reason in words.

    `instruction` is the sequence of the instruction that it is about, None where there is none.
    """

    kind: str
    severity: Severity
    reason: str
    instruction: int | None = None


class HostRecord(Timed, frozen=True, gc=False):
    """Host bytes (a whole frame, a truncated one, or garbage) and the state predicted after them.

    `t` and `end` are the times of the first and the last byte, `known` when it was known that no
    more follow. `judgement` and `sequence` (which counts whole and truncated frames from 0) are
    None for garbage. `note` is the cause of garbage, or why a frame is uncertain.
    """

    end: int
    known: int
    kind: Kind
    data: bytes
    judgement: Judgement | None
    sequence: int | None
    state: State
    note: str = ""

    @property
    def words(self) -> str:
        """The frame in words, like `Speed speed=80`."""
        return self.judgement.describe() if self.judgement else "garbage"

    @property
    def hex(self) -> str:
        """The bytes in hex, like `81 05`."""
        return self.data.hex(" ")

    @property
    def reason(self) -> str:
        """Why the bytes are faulty or uncertain, in words; empty for a valid frame."""
        why = self.judgement.reason if self.judgement else ""
        return "; ".join(filter(None, (why, self.note)))

    @property
    def uncertain(self) -> bool:
        """Whether it is not certain that the bytes are one frame."""
        return bool(self.judgement and self.note)

    @property
    def faults(self) -> tuple[Anomaly, ...]:
        """The anomalies of these bytes by themselves, none for a valid frame that is certain."""
        judgement = self.judgement
        if judgement is None:
            return (Anomaly(self.known, "garbage", Severity.WARNING, self.note),)
        found: tuple[Anomaly, ...] = ()
        if not judgement.valid:
            kind = "truncated" if judgement.truncated else "faulty instruction"
            found = (Anomaly(self.known, kind, Severity.WARNING, judgement.reason, self.sequence),)
        if self.note:
            found += (Anomaly(self.known, UNCERTAIN, Severity.INFO, self.note, self.sequence),)
        return found

    @property
    def value(self) -> Instruction:
        """The record as a capture holds it."""
        judgement = self.judgement
        spec = judgement.instruction if judgement else None
        value = Instruction(
            t=self.t,
            end=self.end,
            kind=self.kind,
            hex=self.hex,
            sequence=self.sequence,
            id=judgement.id if judgement else None,
            name=spec.name if spec else None,
            length=judgement.length if judgement else None,
            fields=plain_values(judgement.values) if judgement else {},
            judgement=judgement.expected if judgement else None,
            reason=self.reason,
        )
        if judgement is None or not judgement.framed:
            return value
        told, address = msgspec.structs.asdict(value), judgement.address
        return FramedInstruction(**told, address=address, uncertain=self.uncertain)


class DeviceRecord(Timed, frozen=True, gc=False):
    """One answer of a device, mostly a byte, with the instruction it answers.

    `reply` is an answer of several bytes, of which `byte` is the code (-1 if it has none) and `t`
    the time of its first one. `answer` is the grammar's entry for the byte, None for an unused
    code. `instruction` is the sequence and `answered` the judgement of the instruction it answers,
    `latency` the time (ns) since that one's last byte; None where there is none. `agrees` tells
    whether it is the expected response, None where nothing is expected.
    """

    byte: int
    answer: ResponseSpec | None
    answered: Judgement | None
    instruction: int | None
    latency: int | None
    agrees: bool | None
    state: State
    faults: tuple[Anomaly, ...] = ()
    reply: Reply | None = None

    @property
    def latency_ns(self) -> int | None:
        """The same as `latency`, under the name that tells its unit."""
        return self.latency

    @property
    def data(self) -> bytes:
        """The bytes."""
        return self.reply.frame if self.reply else bytes([self.byte])

    @property
    def words(self) -> str:
        """The response's name, or that the code is unused; the fields of an answer with data."""
        if self.reply:
            return self.reply.describe()
        return self.answer.name if self.answer else f"unused {self.byte}"

    @property
    def hex(self) -> str:
        """The bytes in hex, like `05`."""
        return self.data.hex(" ")

    @property
    def uncertain(self) -> bool:
        """Whether it is not certain that the bytes are one answer."""
        return any(fault.kind == UNCERTAIN for fault in self.faults)

    @property
    def reason(self) -> str:
        """What is odd about the byte, in words; empty if nothing is."""
        return "; ".join(fault.reason for fault in self.faults) if self.faults else ""

    @property
    def value(self) -> Response | FramedResponse:
        """The record as a capture holds it."""
        told = (self.name, self.instruction, self.latency, self.agrees, self.reason)
        if self.reply is None:
            return Response(self.t, self.hex, self.byte, *told)
        fields = plain_values(self.reply.values)
        address, uncertain = self.reply.address, self.uncertain
        return FramedResponse(self.t, self.hex, *told, fields, address, uncertain)

    @property
    def name(self) -> str | None:
        """The name of the response, those of all flags of it; None for an unused code."""
        if self.reply and self.reply.names:
            return " ".join(self.reply.names)
        return self.answer.name if self.answer else None


def shapes_of(protocol: Protocol) -> Shapes:
    """The classes of what a capture of this protocol holds, where they are not the car's."""
    framed: Shapes = {Instruction: FramedInstruction, Response: FramedResponse}
    own: Shapes = {State: protocol.state_type, Look: look_class(protocol.state_type)}
    return {**own, **({} if protocol.plain else framed)}


class LineRecord(msgspec.Struct, frozen=True):
    """A line event; `lost` is true if bytes are known to be missing."""

    value: Line
    lost: bool
    state: State
    faults: tuple[Anomaly, ...] = ()

    @property
    def t(self) -> int:
        """When it happened (ns)."""
        return self.value.t

    @property
    def t_ns(self) -> int:
        """The same as `t`, under the name that tells its unit."""
        return self.t


class FaultRecord(msgspec.Struct, frozen=True):
    """An anomaly without bytes of its own, such as a missing answer."""

    fault: Anomaly
    state: State

    @property
    def t(self) -> int:
        """When the anomaly was found (ns)."""
        return self.fault.t

    @property
    def t_ns(self) -> int:
        """The same as `t`, under the name that tells its unit."""
        return self.t

    @property
    def value(self) -> Anomaly:
        """The anomaly, which is what a capture holds of the record."""
        return self.fault

    @property
    def faults(self) -> tuple[Anomaly, ...]:
        """The one anomaly."""
        return (self.fault,)


Record: TypeAlias = HostRecord | DeviceRecord | LineRecord | FaultRecord


def severity_of(record: Record) -> Severity | None:
    """The severity of a record's worst anomaly, None if it has none."""
    return max((fault.severity for fault in record.faults), default=None)


def serious_faults(record: Record) -> list[Anomaly]:
    """The anomalies of a record that are warnings or errors."""
    return [fault for fault in record.faults if fault.severity > Severity.INFO]


def serious_kinds(record: Record) -> tuple[str, ...]:
    """The kinds of these anomalies."""
    return tuple(fault.kind for fault in serious_faults(record))


def is_frame(record: Record) -> bool:
    """Whether the record holds bytes (these are the records that `--count` counts)."""
    return isinstance(record, HostRecord | DeviceRecord)


Made = TypeVar("Made")

_MOST = 1 << 14  # frames that are remembered


class PerFrame(Generic[Made]):
    """Calls `make` for a record of the host, and remembers what it gave for the next such frame.

    What is made must depend on the bytes and their judgement alone, and on why the frame is
    uncertain. What is made of garbage, or of an uncertain frame, is not remembered.
    """

    def __init__(self, make: Callable[[HostRecord], Made]) -> None:
        self._make = make
        self._known: dict[bytes, tuple[Judgement, Made]] = {}

    def __call__(self, record: HostRecord) -> Made:
        """What is made of a record."""
        judgement = record.judgement
        if judgement is None or record.note:
            return self._make(record)
        known = self._known.get(judgement.frame)
        if known is None or known[0] is not judgement:  # another grammar judges it otherwise
            if len(self._known) >= _MOST:
                self._known.clear()
            known = self._known[judgement.frame] = judgement, self._make(record)
        return known[1]
