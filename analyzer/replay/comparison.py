"""What is wrong with a device's answers: missing, not allowed, unasked, or not the expected ones.

Expected are given codes, or the answers of another decoded run of the same host bytes. What is not
allowed is what the decoder calls an error: a code that the grammar does not have, or one that no
listed reading of the document allows to this instruction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from bilprov.analyzer.decode.records import (
    UNCERTAIN,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    Record,
    Severity,
    severity_of,
)
from bilprov.captures.text import quantity
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


FLOOD = 64
"""Bytes that answer no instruction, from which on a device counts as flooding the line."""

FLOOD_WORDS = f"the device floods the line: {FLOOD} bytes came that answer no instruction"
UNANSWERED_STOPS = "the device did not answer the stops at the end: it may still be moving"


@dataclass(slots=True)
class AnswerCheck:
    """Counts what is wrong with the answers of a run, in memory that does not grow.

    `sent` counts instructions, `due` those that are to be answered, `answered` those that were.
    `wrong` counts the answers that are not allowed, of which `first_wrong` tells the first;
    `unasked` counts the bytes that answer no instruction, except where that is uncertain (a banner
    before the first instruction).
    """

    sent: int = 0
    due: int = 0
    answered: int = 0
    wrong: int = 0
    first_wrong: str = ""
    unasked: int = 0
    _unpaired: int = 0

    def record(self, record: Record) -> None:
        """Add a record of the run."""
        if isinstance(record, HostRecord):
            self.sent += record.sequence is not None
            self.due += record.judgement is not None and record.judgement.answer_due
        elif isinstance(record, DeviceRecord) and record.instruction is not None:
            self.answered += 1
            if severity_of(record) is Severity.ERROR:
                self.wrong += 1
                self.first_wrong = self.first_wrong or record.reason
        elif isinstance(record, DeviceRecord):
            self._unpaired += len(record.data)
            # Bytes of which only the end is uncertain are unasked all the same.
            doubts = {fault.kind for fault in record.faults if fault.severity is Severity.INFO}
            if doubts <= {UNCERTAIN}:
                self.unasked += len(record.data)

    @property
    def flooded(self) -> bool:
        """Whether so many bytes came that answer no instruction that no answer can be trusted."""
        return self._unpaired >= FLOOD

    @property
    def unasked_words(self) -> str:
        """Tells of the unasked bytes in a sentence; "" if none came."""
        count = self.unasked
        return f"{quantity(count, 'byte')} came without an instruction" if count else ""

    @property
    def wrong_words(self) -> str:
        """Tells of the answers that are not allowed in a sentence; "" if all are."""
        if self.wrong > 1:
            return f"{quantity(self.wrong, 'answer')} are not allowed, first: {self.first_wrong}"
        return f"an answer is not allowed: {self.first_wrong}" if self.wrong else ""

    @property
    def missing_words(self) -> str:
        """Tells of unanswered instructions in a sentence, once the last answer was waited for."""
        missing = self.due - self.answered
        if missing <= 0:
            return ""
        return f"no answer came to {missing} of {quantity(self.due, 'instruction')}"


def first_difference(protocol: Protocol, run: ReplayRun, expected: Sequence[int | None]) -> str:
    """Tell where the answers of a run first differ from the expected codes; "" if nowhere.

    None is expected where no answer should come.
    """
    frames = list(run.frames.items())
    for place, ((sequence, frame), code) in enumerate(zip(frames, expected, strict=False), start=1):
        record = run.answers.get(sequence)
        came = code_of(record)
        if came != code:
            return (
                f"instruction {place} of {len(expected)}, {frame.words} ({frame.hex}): expected "
                f"{answer_words(protocol, code)}, got {answer_words(protocol, came)}"
            )
    if len(frames) != len(expected):
        sent = quantity(len(frames), "instruction")
        return f"{quantity(len(expected), 'answer')} expected, but {sent} sent"
    return ""
