"""Compares two decoded runs of the same host bytes and finds where the answers differ."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from bilprov.analyzer.decode.records import DeviceRecord, FaultRecord, HostRecord, Record
from bilprov.spec.codec import spaced
from bilprov.spec.protocol import PLAIN_ANSWER, Protocol

DAMAGED = -2
"""Stands for the code of an answer that is damaged."""

_KEPT = 16  # unpaired device bytes


@dataclass(slots=True)
class ReplayRun:
    """The instructions of a run and their answers, by sequence, and the unpaired device bytes.

    Of these the first ones are kept, so that a device that floods does not fill the memory, and all
    are counted.
    """

    frames: dict[int, HostRecord] = field(default_factory=dict)
    answers: dict[int, DeviceRecord] = field(default_factory=dict)
    unanswered: set[int] = field(default_factory=set)
    unpaired: list[DeviceRecord] = field(default_factory=list)
    unpaired_count: int = 0

    def record(self, record: Record) -> None:
        """Add a record of the run."""
        if isinstance(record, HostRecord) and record.sequence is not None:
            self.frames[record.sequence] = record
        elif isinstance(record, DeviceRecord):
            sequence = record.instruction
            if sequence is None:
                self.unpaired_count += 1
                if len(self.unpaired) < _KEPT:
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
                f"{words}: its bytes reached the device in other pieces ({spaced(again.data)}); "
                "what follows cannot be compared",
            )
            return
        was, is_now = recorded.answers.get(sequence), now.answers.get(sequence)
        if was is None and sequence not in recorded.unanswered:
            continue
        code, code_now = code_of(was), code_of(is_now)
        if code != code_now:
            yield Difference(
                sequence,
                f"{words}: recorded {answer_words(protocol, code)}, "
                f"now {answer_words(protocol, code_now)}",
            )
    if now.unpaired_count not in (0, recorded.unpaired_count):
        said = " ".join(record.hex for record in now.unpaired)
        yield Difference(
            None,
            f"bytes that answer no instruction: recorded {recorded.unpaired_count}, "
            f"now {now.unpaired_count} ({said})",
        )


def _described(frame: HostRecord) -> str:
    return f"{frame.words} ({frame.hex})"


def code_of(answer: DeviceRecord | None) -> int | None:
    """The code of an answer, DAMAGED where it is not whole or wrong; None is no answer."""
    if answer is None:
        return None
    return DAMAGED if answer.reply and answer.reply.reason else answer.byte


def answer_words(protocol: Protocol, code: int | None) -> str:
    """The answer of this code in words, like `OK (00)`; None is no answer."""
    if code is None:
        return "no answer"
    if code == DAMAGED:
        return "a damaged answer"
    if code == PLAIN_ANSWER.code:
        return PLAIN_ANSWER.prose
    known = protocol.codes.get(code)
    return f"{known.name if known else 'unused'} ({code:02x})"
