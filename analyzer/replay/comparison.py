"""Compares two decoded runs of the same host bytes and finds where the answers differ."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from bilprov.analyzer.decode.records import DeviceRecord, FaultRecord, HostRecord, Record
from bilprov.spec.codec import spaced
from bilprov.spec.protocol import Protocol


@dataclass(slots=True)
class ReplayRun:
    """The instructions of a run and their answers, by sequence, and the unpaired device bytes."""

    frames: dict[int, HostRecord] = field(default_factory=dict)
    answers: dict[int, DeviceRecord] = field(default_factory=dict)
    unanswered: set[int] = field(default_factory=set)
    unpaired: list[DeviceRecord] = field(default_factory=list)

    def record(self, record: Record) -> None:
        """Add a record of the run."""
        if isinstance(record, HostRecord) and record.sequence is not None:
            self.frames[record.sequence] = record
        elif isinstance(record, DeviceRecord):
            sequence = record.instruction
            if sequence is None:
                self.unpaired.append(record)
            else:
                self.answers[sequence] = record
        elif isinstance(record, FaultRecord) and record.fault.instruction is not None:
            self.unanswered.add(record.fault.instruction)


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference, in words, and the sequence of its instruction (None: it belongs to none)."""

    instruction: int | None
    reason: str


def differences(protocol: Protocol, recorded: ReplayRun, now: ReplayRun) -> Iterator[Difference]:
    """Yield the instructions that were answered differently than in the recording.

    An instruction is skipped if the recording ends before its answer.
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
        if (was.byte if was else None) != (is_now.byte if is_now else None):
            yield Difference(
                sequence,
                f"{words}: recorded {_answer(protocol, was)}, now {_answer(protocol, is_now)}",
            )
    if now.unpaired and len(now.unpaired) != len(recorded.unpaired):
        said = " ".join(record.hex for record in now.unpaired[:16])
        yield Difference(
            None,
            f"bytes that answer no instruction: recorded {len(recorded.unpaired)}, "
            f"now {len(now.unpaired)} ({said})",
        )


def _described(frame: HostRecord) -> str:
    return f"{frame.words} ({frame.hex})"


def _answer(protocol: Protocol, record: DeviceRecord | None) -> str:
    if record is None:
        return "no answer"
    return f"{record.answer.name if record.answer else 'unused'} ({record.hex})"
