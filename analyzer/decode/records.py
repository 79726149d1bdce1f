"""What a session decodes: one frozen value for each frame, device byte, line event and fault.

All times are integers in nanoseconds since the session's start.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import TypeAlias

import msgspec

from captures.schemas import Instruction, Line, Response, State
from spec.codec import Judgement
from spec.motion import State as MotionState
from spec.protocol import ResponseSpec


class Severity(IntEnum):
    """How bad a fault is; the numbers are those of Foxglove's log levels."""

    INFO = 2
    WARNING = 3
    ERROR = 4


class Fault(msgspec.Struct, frozen=True):
    """Something odd: what kind of oddity, how bad, and why it is one, in words.

    `instruction` is the sequence of the instruction that it is about, None where there is none.
    """

    t: int
    kind: str
    severity: Severity
    reason: str
    instruction: int | None = None


class HostRecord(msgspec.Struct, frozen=True):
    """Host bytes: a whole frame, one cut short, or garbage; and the state predicted after them.

    `judgement` is None for garbage. `faults` are those that this frame shows by itself.
    """

    value: Instruction
    data: bytes
    judgement: Judgement | None
    state: State
    faults: tuple[Fault, ...] = ()


class DeviceRecord(msgspec.Struct, frozen=True):
    """One device byte.

    `answer` is what the grammar calls the byte, None for an unused code; `answered` the judgement
    of the instruction it answers, None where there is none.
    """

    value: Response
    answer: ResponseSpec | None
    answered: Judgement | None
    state: State
    faults: tuple[Fault, ...] = ()


class LineRecord(msgspec.Struct, frozen=True):
    """Something that happened to a line; `lost` tells whether bytes are known to be missing."""

    value: Line
    lost: bool
    state: State
    faults: tuple[Fault, ...] = ()


class FaultRecord(msgspec.Struct, frozen=True):
    """A fault that no frame stands for, such as an answer that never came."""

    fault: Fault
    state: State


Record: TypeAlias = HostRecord | DeviceRecord | LineRecord | FaultRecord


def faults_of(record: Record) -> tuple[Fault, ...]:
    """Every fault that the record tells of."""
    return (record.fault,) if isinstance(record, FaultRecord) else record.faults


def is_frame(record: Record) -> bool:
    """Whether the record stands for bytes (this is what `--count` counts)."""
    return isinstance(record, HostRecord | DeviceRecord)


@lru_cache(maxsize=4096)
def written_state(state: MotionState) -> State:
    """The motion state as it is written out: `motion` as set, `moving` whether the wheels turn."""
    return State(state.motion.value, state.speed, state.steering, state.led, state.moving)
