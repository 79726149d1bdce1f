"""The records that a session decodes: a frozen value per frame, device byte, event and anomaly.

All times are integers in nanoseconds since the session's start.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import TypeAlias

import msgspec

from bilprov.captures.schemas import Instruction, Line, Response, State
from bilprov.spec.codec import Judgement
from bilprov.spec.motion import State as MotionState
from bilprov.spec.protocol import ResponseSpec


class Severity(IntEnum):
    """The severity of an anomaly; the numbers are those of Foxglove's log levels."""

    INFO = 2
    WARNING = 3
    ERROR = 4


class Anomaly(msgspec.Struct, frozen=True):
    """An anomaly in the traffic: its time `t` (ns), kind, severity, and reason in words.

    `instruction` is the sequence of the instruction that it is about, None where there is none.
    """

    t: int
    kind: str
    severity: Severity
    reason: str
    instruction: int | None = None


class HostRecord(msgspec.Struct, frozen=True):
    """Host bytes (a whole frame, a truncated one, or garbage) and the state predicted after them.

    `judgement` is None for garbage. `faults` are the anomalies of this frame by itself.
    """

    value: Instruction
    data: bytes
    judgement: Judgement | None
    state: State
    faults: tuple[Anomaly, ...] = ()

    @property
    def words(self) -> str:
        """The frame in words, like `Speed speed=80`."""
        return self.judgement.describe() if self.judgement else "garbage"


class DeviceRecord(msgspec.Struct, frozen=True):
    """One device byte, with the instruction it answers.

    `answer` is the grammar's entry for the byte, None for an unused code; `answered` is the
    judgement of the instruction it answers, None where there is none.
    """

    value: Response
    answer: ResponseSpec | None
    answered: Judgement | None
    state: State
    faults: tuple[Anomaly, ...] = ()

    @property
    def words(self) -> str:
        """The response's name, or that the code is unused."""
        return self.value.name or f"unused {self.value.byte}"


class LineRecord(msgspec.Struct, frozen=True):
    """A line event; `lost` is true if bytes are known to be missing."""

    value: Line
    lost: bool
    state: State
    faults: tuple[Anomaly, ...] = ()


class FaultRecord(msgspec.Struct, frozen=True):
    """An anomaly without bytes of its own, such as a missing answer."""

    fault: Anomaly
    state: State

    @property
    def value(self) -> Anomaly:
        """The anomaly, which is what has the time here."""
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


def is_frame(record: Record) -> bool:
    """Whether the record holds bytes (these are the records that `--count` counts)."""
    return isinstance(record, HostRecord | DeviceRecord)


@lru_cache(maxsize=4096)
def written_state(state: MotionState) -> State:
    """Convert a motion state to its written form; `moving` tells whether the wheels turn."""
    return State(state.motion.value, state.speed, state.steering, state.led, state.moving)
