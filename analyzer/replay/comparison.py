"""Two decoded runs of the same host bytes: where a device answered differently. Values only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from analyzer.decode.records import DeviceRecord, FaultRecord, HostRecord, Record
from spec.codec import spaced
from spec.protocol import Protocol


@dataclass(slots=True)
class Run:
    """The instructions of a run with the answer to each, by sequence, and what answered nothing."""

    frames: dict[int, HostRecord] = field(default_factory=dict)
    answers: dict[int, DeviceRecord] = field(default_factory=dict)
    unanswered: set[int] = field(default_factory=set)
    unpaired: list[DeviceRecord] = field(default_factory=list)

    def record(self, record: Record) -> None:
        """Take a record of the run."""
        if isinstance(record, HostRecord) and record.value.sequence is not None:
            self.frames[record.value.sequence] = record
        elif isinstance(record, DeviceRecord):
            sequence = record.value.instruction
            if sequence is None:
                self.unpaired.append(record)
            else:
                self.answers[sequence] = record
        elif isinstance(record, FaultRecord) and record.fault.instruction is not None:
            self.unanswered.add(record.fault.instruction)


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference: the instruction's sequence (None: it belongs to none), and it in words."""

    instruction: int | None
    reason: str


def differences(protocol: Protocol, recorded: Run, now: Run) -> Iterator[Difference]:
    """Every instruction that was answered otherwise than in the recording.

    An instruction whose answer the recording does not hold, because it ends before, is passed over.
    """
    for sequence, frame in recorded.frames.items():
        again = now.frames.get(sequence)
        words = f"instruction {sequence}, {_described(frame)}"
        if again is None:
            yield Difference(sequence, f"{words}: it was not sent")
            return
        if again.data != frame.data:
            yield Difference(
                sequence,
                f"{words}: its bytes reached the device cut otherwise ({spaced(again.data)}); "
                "what follows cannot be compared",
            )
            return
        was, is_now = recorded.answers.get(sequence), now.answers.get(sequence)
        if was is None and sequence not in recorded.unanswered:
            continue
        if (was.value.byte if was else None) != (is_now.value.byte if is_now else None):
            yield Difference(
                sequence,
                f"{words}: recorded {_answer(protocol, was)}, now {_answer(protocol, is_now)}",
            )
    if now.unpaired and len(now.unpaired) != len(recorded.unpaired):
        said = " ".join(record.value.hex for record in now.unpaired[:16])
        yield Difference(
            None,
            f"bytes that answer no instruction: recorded {len(recorded.unpaired)}, "
            f"now {len(now.unpaired)} ({said})",
        )


def _described(frame: HostRecord) -> str:
    words = frame.judgement.describe() if frame.judgement else "garbage"
    return f"{words} ({frame.value.hex})"


def _answer(protocol: Protocol, record: DeviceRecord | None) -> str:
    if record is None:
        return "no answer"
    return f"{record.value.name or 'unused'} ({record.value.hex})"
