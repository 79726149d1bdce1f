"""The names that a filter knows: what kind of value each has, its limits, and the values' names.

And what moments and units of time mean.
"""

from __future__ import annotations

import time
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from datetime import time as clock
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple, TypeAlias, get_args

from bilprov.analyzer.decode.anomalies import KINDS, LINE_SEVERITY
from bilprov.analyzer.decode.json_lines import OUTCOME_WORDS
from bilprov.captures.schemas import Direction, FrameKind
from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import NO_ANSWER, PLAIN_ANSWER, Protocol

Value: TypeAlias = "bool | int | str"

UNCODED, NONE = -1, -2
"""The numbers of an answer without a code, and of no answer, which are compared by name."""


class Kind(StrEnum):
    """The kinds of values, in words. Those of different kinds are never compared."""

    NUMBER = "a number"
    SECONDS = "a time in seconds"
    CLOCK = "a time of day"
    WORD = "a word"
    WORDS = "a list of words"
    TEXT = "text"
    TRUTH = "true or false"
    BYTES = "bytes"


ORDERED = ("==", "!=", "<", "<=", ">", ">=")
SIGNS: Mapping[Kind, tuple[str, ...]] = {
    Kind.NUMBER: (*ORDERED, "in", "&"),
    Kind.SECONDS: (*ORDERED, "in"),
    Kind.CLOCK: ("<", "<=", ">", ">=", "in"),
    Kind.WORD: ("==", "!=", "in", "contains"),
    Kind.WORDS: ("contains", "==", "!="),
    Kind.TEXT: ("contains", "==", "!=", "in"),
    Kind.TRUTH: ("==", "!="),
    Kind.BYTES: ("contains", "==", "!=", "in"),
}
"""The signs behind a name of each kind. A number with names of values has `contains` too."""

_EXAMPLES = {
    Kind.SECONDS: "> 20ms",
    Kind.CLOCK: "> 14:03:20",
    Kind.TEXT: "contains 'late'",
    Kind.BYTES: "contains 11 ff",
}
_MOST_LISTED = 12  # values that a sentence lists


@dataclass(frozen=True, slots=True)
class Field:
    """A name of the language.

    `key` is what it is in a row (the name itself, but for fields of the grammar) and `says` what it
    is in words. `low` and `high` are the ends of what a number can be, None where there is none.
    `words` are the values' names with what each stands for; a word without a name is no value.
    """

    name: str
    kind: Kind
    says: str
    key: str = ""
    low: int | None = None
    high: int | None = None
    words: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "key", self.key or self.name)

    @property
    def signs(self) -> tuple[str, ...]:
        """The signs that may stand behind it."""
        if self.kind is not Kind.NUMBER or not self.words:
            return SIGNS[self.kind]
        by_name = {UNCODED, NONE} & {*self.words.values()}
        return (*(("==", "!=", "in") if by_name else SIGNS[self.kind]), "contains")

    def value_of(self, word: str) -> Value | None:
        """What a value's name stands for, in any case; None if it is none."""
        if word in self.words:
            return self.words[word]
        same = folded(word)
        return next((value for name, value in self.words.items() if folded(name) == same), None)

    @property
    def kind_of(self) -> str:
        """What kind of value it has, in words."""
        if self.kind is Kind.WORD:
            return f"a word like {next(iter(self.words))}"
        named = self.kind is Kind.NUMBER and self.words
        return f"{self.kind} or a name like {next(iter(self.words))}" if named else str(self.kind)

    @property
    def example(self) -> str:
        """A condition with it."""
        if self.kind is Kind.WORDS:
            return f"{self.name} contains {next(iter(self.words))!r}"
        if self.words:
            return f"{self.name} == {next(iter(self.words))}"
        return f"{self.name} {_EXAMPLES.get(self.kind, f'> {self.low or 0}')}"

    @property
    def listed(self) -> str:
        """The names of its values, as many as fit into a sentence."""
        words = list(self.words)
        more = f" and {len(words) - _MOST_LISTED} more" if len(words) > _MOST_LISTED else ""
        return ", ".join(words[:_MOST_LISTED]) + more


def folded(word: str) -> str:
    """A name in one case and one form, by which names are compared."""
    return unicodedata.normalize("NFKC", word).casefold()


@lru_cache(maxsize=8)
def fields_of(protocol: Protocol) -> Mapping[str, Field]:
    """All names of a grammar's filters.

    A field of an instruction that is named like another one is reached as `fields.NAME` only.
    """
    rows = (*_of_rows(protocol), *_of_frames(protocol), *_of_state(protocol))
    own = {each.name: each for each in rows}
    parts = {part.name: _part(protocol, part.name) for _, part in _parts(protocol)}
    return {**parts, **own, **{part.key: part for part in parts.values()}}


@lru_cache(maxsize=8)
def bytes_names(protocol: Protocol) -> frozenset[str]:
    """The names of what is bytes, in lower case."""
    fields = fields_of(protocol).items()
    return frozenset(name.lower() for name, one in fields if one.kind is Kind.BYTES)


def find(protocol: Protocol, name: str) -> Field | None:
    """The field of that name, in any case; None if there is none.

    What is spelled like a value is one: beside the field `speed`, `Speed` is an instruction.
    """
    fields = fields_of(protocol)
    if name in fields or name in _spelled(protocol):
        return fields.get(name)
    return by_folded(protocol).get(folded(name))


@lru_cache(maxsize=8)
def _spelled(protocol: Protocol) -> frozenset[str]:
    return frozenset(word for each in fields_of(protocol).values() for word in each.words)


@lru_cache(maxsize=8)
def by_folded(protocol: Protocol) -> Mapping[str, Field]:
    """The fields by their names in one case."""
    return {folded(name): each for name, each in reversed([*fields_of(protocol).items()])}


def _of_rows(protocol: Protocol) -> list[Field]:
    number, seconds, word, truth = Kind.NUMBER, Kind.SECONDS, Kind.WORD, Kind.TRUTH
    ids = {spec.name: spec.id for spec in protocol.instructions}
    codes = {spec.name: spec.code for spec in protocol.responses}
    given = {**codes, PLAIN_ANSWER.name: UNCODED} if protocol.uncoded else codes
    due = codes if protocol.plain else {**codes, Outcome.VALID.value: UNCODED, NO_ANSWER.name: NONE}
    uncoded = [] if protocol.reply.part("code") else [PLAIN_ANSWER.name]
    names = _itself([*protocol.by_name, *codes, *uncoded, *_ROWS_OF_THEIR_OWN])
    kinds = _itself([*get_args(FrameKind), "fault"])
    longest = protocol.data_lengths[-1]
    came = "the response code that the device sent"
    right = "the response that a conforming device gives to the instruction"
    named = "the name of the instruction, the response or the anomaly"
    length = "the data bytes that the header announces" if protocol.plain else "its data bytes"
    odd = "a faulty instruction or its answer, or anything else odd"
    return [
        Field("id", number, "the ID in the header", "", 0, protocol.ids[-1], ids),
        Field("len", number, length, "", 0, longest),
        Field("data", Kind.BYTES, "the bytes behind the header; data[0] is the first"),
        Field("sequence", number, "the instruction's number, from 0", low=0),
        Field("response", number, came, "", min([0, *given.values()]), 255, given),
        Field("latency", seconds, "from the instruction's last byte to the answer"),
        Field("latency_ns", number, "the same in ns"),
        Field("answers", number, "the number of the instruction that it answers", low=0),
        Field("agrees", truth, "whether the answer is the expected one", words=_TRUTH),
        Field("name", word, named, words=names),
        Field("direction", word, "host or device", words=_itself(get_args(Direction))),
        Field("kind", word, "the kind of the row", words=kinds),
        Field("hex", Kind.BYTES, "all bytes of the row; hex[0] is the first"),
        Field("bytes", Kind.BYTES, "the same as hex", "hex"),
        Field("judgement", number, right, "", min([0, *due.values()]), 255, due),
        Field("faulty", truth, odd, words=_TRUTH),
        Field("faults", Kind.WORDS, "the kinds of anomalies", words=_itself(KINDS)),
        Field("reason", Kind.TEXT, "why, in words"),
        Field("t", seconds, "since the start of the recording"),
        Field("t_ns", number, "the same in ns"),
        Field("time", Kind.CLOCK, "the time of day, or with a date before it"),
    ]


def _of_frames(protocol: Protocol) -> Iterator[Field]:
    """What rows have where more than a header byte stands around the data."""
    part = protocol.layout.part("address")
    if part is not None:
        yield Field("address", Kind.NUMBER, "who is meant, or who answers", "", 0, part.most)
    if not protocol.plain:
        words = _itself(OUTCOME_WORDS)
        yield Field("outcome", Kind.WORD, "how the instruction is judged", words=words)
        yield Field("uncertain", Kind.TRUTH, "whether it may not be one frame", words=_TRUTH)


def _of_state(protocol: Protocol) -> Iterator[Field]:
    for variable, spec in protocol.variables.items():
        name, says = f"state.{variable}", f"the predicted {variable}"
        if spec.words:
            yield Field(name, Kind.WORD, says, words=_itself(spec.words))
        else:
            yield Field(name, Kind.NUMBER, says, "", spec.low, spec.high)
    if protocol.at_rest:
        says = "whether the wheels turn" if protocol.wheels else "whether it is not at rest"
        yield Field("state.moving", Kind.TRUTH, says, words=_TRUTH)


def _part(protocol: Protocol, name: str) -> Field:
    """The field of that name in any instruction, or its answer, that has it."""
    owned = [(owner, part) for owner, part in _parts(protocol) if part.name == name]
    owners = ", ".join(dict.fromkeys(owner for owner, _ in owned))
    says = f"of {owners}: {owned[0][1].prose}"
    parts = [part for _, part in owned]
    if any(part.many for part in parts):
        return Field(name, Kind.BYTES, says, f"fields.{name}")
    carried = [end for part in parts if part.number for end in (part.number.low, part.number.high)]
    words = {word: value for part in parts for word, value in (*part.names, *part.flags)}
    return Field(name, Kind.NUMBER, says, f"fields.{name}", min(carried), max(carried), words)


def _parts(protocol: Protocol) -> Iterator[tuple[str, FieldSpec]]:
    """The fields with values, each with its instruction's name; registers with their memory's."""
    for spec in protocol.instructions:
        answered = spec.answer.fields if spec.answer else ()
        for part in (*spec.fields, *answered):
            if part.constant is None:
                yield spec.name, part
    for memory, cells in protocol.registers.items():
        yield from ((memory, part) for part in cells.values())


def _itself(words: Iterable[str]) -> Mapping[str, Value]:
    return {str(word): str(word) for word in words}


_TRUTH: Mapping[str, Value] = {"true": True, "false": False}

# The anomalies without bytes of their own: of their rows, `name` is the kind.
_ROWS_OF_THEIR_OWN = ("unanswered", *LINE_SEVERITY)


SECOND = 1_000_000_000  # ns
DAY = 86_400 * SECOND  # ns
STEP = 900 * SECOND
"""Ns between the moments at which a time zone may change its offset: all do at a quarter."""


class Instant(NamedTuple):
    """A moment in ns: since midnight if it is `daily`, or else since 1970."""

    daily: bool
    ns: int


def instant(text: str) -> Instant | None:
    """The moment that is written as `14:03:20`, `2026-11-22 14:03:20` or `2026-11-22`.

    Minutes are enough, and microseconds count. A date is local, unless `Z` or an offset like
    `+02:00` stands behind it. None for what is no moment.
    """
    try:
        if "-" in text[:5]:
            return Instant(False, round(datetime.fromisoformat(text).timestamp() * 1e6) * 1000)
        at = clock.fromisoformat(f"0{text}" if text[1:2] == ":" else text)
    except (ValueError, OverflowError, OSError):
        return None
    seconds = (at.hour * 60 + at.minute) * 60 + at.second
    return None if at.tzinfo else Instant(True, seconds * SECOND + at.microsecond * 1000)


@lru_cache(maxsize=4096)
def offset(step: int) -> int:
    """How far (ns) local time is ahead of UTC from a moment on: a number of STEPs since 1970."""
    return time.localtime(step * STEP // SECOND).tm_gmtoff * SECOND


UNITS: Mapping[str, int] = {"us": -6, "ms": -3, "s": 0, "µs": -6, "μs": -6}  # both letters mu
"""The units of time, each as the power of ten that it is of a second."""
