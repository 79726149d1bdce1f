"""What is wrong with a device's answers: missing, not allowed, unasked, or not the expected ones.

Expected are given codes, or the answers of another decoded run of the same host bytes. What is not
allowed is what the decoder calls an error: a code that the grammar does not have, or one that no
listed reading of the document allows to this instruction.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from bilprov.analyzer.decode.records import (
    UNCERTAIN,
    Anomaly,
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

_MOST_UNASKED = 1 << 16  # bytes kept behind one frame: a flood must not fill the memory
_SURPLUS = 1 << 12  # bytes that a device may be ahead of its recording with


@dataclass(slots=True, eq=False)
class Exchange:
    """A frame of the host and its answer. The first one of a capture has no frame.

    `missing` tells that no answer came; without it and without an answer it is not known if one
    would have come. `unasked` are device bytes behind it that answer no instruction. `selected` is
    true if the frame is or what was found of its answer, which was known at `until` (ns).
    """

    frame: HostRecord | None
    answer: DeviceRecord | None = None
    missing: bool = False
    unasked: bytearray = field(default_factory=bytearray)
    settled: bool = True
    selected: bool = False
    until: int = 0

    @property
    def code(self) -> int | None:
        """The code of the answer, DAMAGED where it is not whole or wrong; None is no answer."""
        if self.answer is None:
            return None
        return DAMAGED if self.answer.reply and self.answer.reply.reason else self.answer.byte

    @property
    def key(self) -> tuple[str, bytes]:
        """What has to be the same in two captures for them to be compared."""
        return (self.frame.kind, self.frame.data) if self.frame else ("", b"")

    @property
    def told(self) -> bool:
        """Whether it is known what was answered."""
        return self.missing or self.answer is not None


class Exchanges:
    """Puts the records of a run together; `rest` are the exchanges that are not handed out.

    Without `paired` only one side was heard, and no answers are waited for. `surplus` counts the
    device bytes that answer no instruction.
    """

    def __init__(self, *, paired: bool = True) -> None:
        self.rest: deque[Exchange] = deque([Exchange(None)])
        self.surplus = 0
        self._paired = paired
        self._waiting: dict[int, Exchange] = {}

    def record(self, record: Record, *, selected: bool = False) -> None:
        """Add the next record."""
        number = None
        if isinstance(record, HostRecord):
            waits = self._paired and record.sequence is not None
            self.rest.append(Exchange(record, settled=not waits))
            if waits and record.sequence is not None:
                self._waiting[record.sequence] = self.rest[-1]
                self.rest[-1].selected = selected
        elif isinstance(record, DeviceRecord):
            number = record.instruction
            if number is None:
                self.surplus += len(record.data)
                unasked = self.rest[-1].unasked
                unasked += record.data[: _MOST_UNASKED - len(unasked)]
        elif isinstance(record, FaultRecord):
            number = record.fault.instruction
        elif record.lost:
            self.give_up()
        if number is not None and (exchange := self._waiting.pop(number, None)):
            exchange.answer = record if isinstance(record, DeviceRecord) else None
            exchange.missing, exchange.settled = exchange.answer is None, True
            exchange.selected |= selected
            exchange.until = record.t

    def give_up(self) -> None:
        """No more will be known of those that wait."""
        for exchange in self._waiting.values():
            exchange.settled = True
        self._waiting.clear()

    def settled(self) -> Iterator[Exchange]:
        """Yield those of which all is known; the last one may still get unasked bytes."""
        while len(self.rest) > 1 and self.rest[0].settled:
            yield self.rest.popleft()

    def instructions(self) -> dict[int, Exchange]:
        """Those of instructions, by sequence."""
        frames = ((one.frame, one) for one in self.rest)
        return {
            frame.sequence: one for frame, one in frames if frame and frame.sequence is not None
        }

    @property
    def flooded(self) -> bool:
        """Whether so many bytes came that answer no instruction that no answer can be trusted."""
        return self.surplus >= FLOOD

    def floods(self, recorded: Exchanges) -> bool:
        """Whether far more bytes answer no instruction than in the recording so far."""
        return self.surplus - recorded.surplus > _SURPLUS

    @property
    def unasked(self) -> bytes:
        """The device bytes that answer no instruction."""
        return b"".join(one.unasked for one in self.rest)


def differences(protocol: Protocol, recorded: Exchanges, now: Exchanges) -> Iterator[Anomaly]:
    """Yield the instructions that were answered differently than in the recording.

    An instruction is skipped if the recording ends before its answer.
    """
    sent = now.instructions()
    for sequence, was in recorded.instructions().items():
        assert was.frame is not None
        again = sent.get(sequence)
        reason = ""
        if again is None or again.frame is None:
            reason = "it was not sent"
        elif again.key != was.key:
            reason = (
                "its bytes reached the device in other pieces "
                f"({spaced(again.frame.data)}); what follows cannot be compared"
            )
        elif was.told and was.code != again.code:
            answers = answer_words(protocol, was.code), answer_words(protocol, again.code)
            reason = "recorded {}, now {}".format(*answers)
        if reason:
            words = f"instruction {sequence}, {_described(was.frame)}: {reason}"
            yield Anomaly(was.frame.t, "difference", Severity.ERROR, words, sequence)
        if again is None or again.key != was.key:
            return
    before, unasked = len(recorded.unasked), now.unasked
    if len(unasked) not in (0, before):
        said = unasked[:16].hex(" ")
        words = f"bytes that answer no instruction: recorded {before}, now {len(unasked)} ({said})"
        yield Anomaly(0, "difference", Severity.ERROR, words)


def _described(frame: HostRecord) -> str:
    return f"{frame.words} ({frame.hex})"


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
    before the first instruction). `echoed` says that an instruction came back.
    """

    sent: int = 0
    due: int = 0
    answered: int = 0
    wrong: int = 0
    first_wrong: str = ""
    unasked: int = 0
    echoed: bool = False
    _asked: bytes = b""
    _heard: bytes = b""

    def record(self, record: Record) -> None:
        """Add a record of the run."""
        if isinstance(record, DeviceRecord) and len(self._heard) < len(self._asked):
            self._heard += record.data
        if isinstance(record, HostRecord):
            self._asked, self._heard = record.data, b""
            self.sent += record.sequence is not None
            self.due += record.judgement is not None and record.judgement.answer_due
        elif isinstance(record, DeviceRecord) and record.instruction is not None:
            self.answered += 1
            if severity_of(record) is Severity.ERROR:
                self.wrong += 1
                self.first_wrong = self.first_wrong or record.reason
        elif isinstance(record, DeviceRecord):
            self.echoed |= bool(self._asked) and self._heard.startswith(self._asked)
            # Bytes of which only the end is uncertain are unasked all the same.
            doubts = {fault.kind for fault in record.faults if fault.severity is Severity.INFO}
            if doubts <= {UNCERTAIN}:
                self.unasked += len(record.data)

    @property
    def unasked_words(self) -> str:
        """Tells of the unasked bytes in a sentence; "" if none came."""
        count = self.unasked
        echo = "; what was sent came back: where the line has an echo, use --echo"
        said = f"{quantity(count, 'byte')} came without an instruction"
        return said + echo * self.echoed if count else ""

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


def first_difference(protocol: Protocol, run: Exchanges, expected: Sequence[int | None]) -> str:
    """Tell where the answers of a run first differ from the expected codes; "" if nowhere.

    None is expected where no answer should come.
    """
    sent = list(run.instructions().values())
    for place, (one, code) in enumerate(zip(sent, expected, strict=False), start=1):
        if one.frame and one.code != code:
            return (
                f"instruction {place} of {len(expected)}, {_described(one.frame)}: expected "
                f"{answer_words(protocol, code)}, got {answer_words(protocol, one.code)}"
            )
    if len(sent) != len(expected):
        count = quantity(len(sent), "instruction")
        return f"{quantity(len(expected), 'answer')} expected, but {count} sent"
    return ""
