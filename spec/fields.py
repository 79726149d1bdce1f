"""Declarations that a grammar uses besides construct's own: ranges, effects, responses, timing.

Each keeps its arguments as public attributes. construct's own validators hide theirs in a closure,
and a grammar whose ranges cannot be read could be used for nothing but parsing. Each raises
WrongValue, in one sentence, for an argument of another type than its annotation has.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from itertools import pairwise
from typing import Annotated, Any, Literal

import construct
from construct import Construct
from msgspec import Meta

from bilprov.spec.checks import Crc, Fletcher, Sum, Xor
from bilprov.spec.errors import Declared, WrongValue, checked
from bilprov.spec.motion import Wheels
from bilprov.spec.state import AllOf, AnyOf, Bits, Changed, From, Unknown, Variables, Whole, Word

__all__ = ["AllOf", "AnyOf", "Bits", "Changed", "Crc", "Fletcher", "From", "Sum", "Unknown"]
__all__ += ["Variables", "Wheels", "Whole", "Word", "Xor"]  # above: of other modules
__all__ += ["Address", "Answer", "Answers", "Clauses", "Data", "Instruction", "Length", "asked"]
__all__ += ["LineDefaults", "Memory", "Outcome", "Ranged", "Reports", "Same", "Sets", "Timing"]

Natural = Annotated[int, Meta(ge=0)]
Code = Annotated[int, Meta(ge=0, le=255)]
Milliseconds = Annotated[float, Meta(gt=0.001, le=3_600_000)]


class Outcome(Enum):
    """Outcome of judging an instruction; the grammar gives each its response code."""

    VALID = "valid"
    UNKNOWN_ID = "unknown ID"
    BAD_DATA = "bad data"
    TOO_MANY = "too many data bytes"
    TOO_FEW = "too few data bytes"
    BAD_CHECKSUM = "bad checksum"
    BAD_SYNC = "bad sync"
    OTHER_ADDRESS = "other address"


class Ranged(construct.Validator):  # type: ignore[misc]  # construct ships no types
    """An integer that must lie in `low`..`high` (both included).

    `bits` names its lowest bits, most significant first, if each has a meaning: "RGB" says that R
    is bit 2, G bit 1 and B bit 0. `reading` names the reading by which a value out of the range is
    bad data, and `code` the answer to it where it is not that to any bad data.
    """

    @checked
    def __init__(
        self,
        subcon: Construct,
        low: int,
        high: int,
        bits: str = "",
        reading: str = "",
        code: str = "",
    ) -> None:
        super().__init__(subcon)
        self.code = code
        self.reading = reading
        self.low = low
        self.high = high
        self.bits = bits

    def _validate(self, obj: Any, context: Any, path: str) -> bool:
        return bool(self.low <= obj <= self.high)


class Reports(construct.Subconstruct):  # type: ignore[misc]  # construct ships no types
    """A field of an answer that tells the variable `variable` of the state.

    It holds the variable's value times `factor` plus `plus`; of a Word the value of that name of an
    Enum. What it reports is predicted from then on.
    """

    @checked
    def __init__(self, variable: str, subcon: Construct, factor: int = 1, plus: int = 0) -> None:
        super().__init__(subcon)
        self.variable = variable
        self.factor = factor
        self.plus = plus


class Sets:
    """Effect of an instruction on the state: each named variable gets a value or a field.

    Variables that are not named keep their value. A Changed makes the new value of the old one; an
    Unknown says that it is not told.
    """

    def __init__(self, **values: int | str | From | Changed | Unknown) -> None:
        self.values = values


class Memory(Declared, frozen=True):
    """Cells of a device's memory `name`, so that what was written is read back.

    A request with the fields `at` and `value` writes them; one with `at`, whose answer has `value`,
    reads them. `at` is the first cell, times `factor` (of bytes the number that they are, high byte
    first); with `latest` it is that of the latest request that had it. `value` holds the cells: a
    number is one, bytes and several numbers are one each. `count` is the field of the request that
    tells how many are read. With `bits` a cell is one bit, eight to a byte and the first in bit 0.
    Each value of the field `of` has cells of its own. `by` names the instructions that use them,
    where others have these fields too; `only` is "reads" or "writes" where they do not do both.

    Without `at` the first cell is 0. A cell is 0 until it is written, or what `power_on` has for
    its place; the instruction `reset` brings it back to that. Bits that are set in the field `keep`
    stay as they are in a cell. What is written takes effect with the next instruction `until`,
    which is answered `code` where there is nothing to take effect. With `blocks` the value is for
    several devices: for each its address and `count` cells.
    """

    name: str
    at: str = ""
    value: str = ""
    count: str = ""
    factor: Annotated[int, Meta(ge=1)] = 1
    bits: bool = False
    of: str = ""
    latest: bool = False
    by: tuple[str, ...] = ()
    only: Literal["", "reads", "writes"] = ""
    power_on: Mapping[Natural, Natural] = {}
    keep: str = ""
    until: str = ""
    blocks: bool = False
    reset: str = ""
    code: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blocks and not self.count:
            raise WrongValue(
                "a Memory with blocks needs a count, the number of cells in each block"
            )

    def cell(self, at: int | bytes) -> int:
        """The first cell for a value of the field `at`."""
        return (int.from_bytes(at, "big") if isinstance(at, bytes) else at) * self.factor


NO_DATA = construct.Struct()
"""The answer of an instruction that asks for no data."""


class Instruction(construct.Struct):  # type: ignore[misc]  # construct ships no types
    """The data of one instruction (its fields in order), its name in the document, its effect.

    `answer` is the data of its answer, None where it is not answered at all. `changes` names what
    it changes that the state does not have, such as "flash", "" that it changes nothing.
    """

    @checked
    def __init__(
        self,
        *fields: Construct,
        document: str,
        effect: Sets | None = None,
        answer: Construct | None = NO_DATA,
        changes: str | None = None,
    ) -> None:
        super().__init__(*fields)
        self.document = document
        self.changes = changes
        self.answer = answer
        self.effect = effect or Sets()


class Answer(Declared, frozen=True):
    """A response: its name, the outcome it stands for, the document's text and our description.

    It may stand for several outcomes, and with () for none: it tells the device's own condition.
    """

    name: Annotated[str, Meta(min_length=1, max_length=64)]
    outcome: Outcome | tuple[Outcome, ...]
    document: str
    prose: str

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcomes that it stands for."""
        several = self.outcome if isinstance(self.outcome, tuple) else (self.outcome,)
        return tuple(map(Outcome, several))


class Answers(construct.ExprAdapter):  # type: ignore[misc]  # construct ships no types
    """A response code that is one of `answers` (code -> Answer); parses to the answer's name.

    With `flags` a code other than 0 is one bit, and several may be set: it parses to their names.
    """

    @checked
    def __init__(
        self, subcon: Construct, answers: Mapping[Code, Answer], flags: bool = False
    ) -> None:
        for code in answers if flags else ():
            if code.bit_count() > 1:
                raise WrongValue(f"the response {code} is not one bit, as flags must be")
        codes = {answer.name: code for code, answer in answers.items()}
        super().__init__(
            subcon,
            decoder=lambda code, _: " ".join(answers[one].name for one in codes_in(code, flags)),
            encoder=lambda names, _: sum(codes[name] for name in names.split()),
        )
        self.answers = answers
        self.flags = flags


def codes_in(code: int, flags: bool) -> list[int]:
    """The codes in a code: itself, or with `flags` each bit that is set."""
    bits = [1 << place for place in range(code.bit_length()) if code >> place & 1]
    return bits if flags and code else [code]


class Timing(Declared, frozen=True):
    """Times in ms that the document leaves open; the named readings give the reasons."""

    truncation_timeout: Milliseconds  # R-truncation-timeout: between two bytes of a frame
    truncation_shortest: Milliseconds
    truncation_longest: Milliseconds
    answer_deadline: Milliseconds  # R-answer-deadline: after the frame's last byte
    answer_longest: Milliseconds
    stop_longest: Milliseconds  # R-stop-latency: after the answer

    def __post_init__(self) -> None:
        super().__post_init__()
        truncation = ("truncation_shortest", "truncation_timeout", "truncation_longest")
        for first, then in (*pairwise(truncation), ("answer_deadline", "answer_longest")):
            least, most = getattr(self, first), getattr(self, then)
            if least > most:
                raise WrongValue(
                    f"Timing.{then} is {most:g}, allowed is at least Timing.{first}, {least:g}"
                )


class LineDefaults(Declared, frozen=True):
    """Default settings of the serial line (R-line)."""

    baud: Annotated[int, Meta(ge=1, le=1_000_000_000)]
    parity: Literal["N", "E", "O", "M", "S"]
    stopbits: Annotated[float, Meta(ge=1, le=2, multiple_of=0.5)]


class Clauses(Declared, frozen=True):
    """The clause of the document in which each kind of rule stands."""

    header: str
    instructions: str
    responses: str
    safety: str


asked = construct.this._params.asked
"""The request that a reply answers: `Bytes(asked.size)` has as many bytes as its field `size`."""


class Address(construct.Subconstruct):  # type: ignore[misc]  # construct ships no types
    """The part that names who is meant: `low` to `high`, and `broadcast` for all, if there is one.

    What is sent to all is not answered.
    """

    @checked
    def __init__(
        self, subcon: Construct, low: Natural, high: Natural, broadcast: Natural | None = None
    ) -> None:
        if low > high:
            raise WrongValue(f"the addresses {low} to {high} hold nothing")
        super().__init__(subcon)
        self.low = low
        self.high = high
        self.broadcast = broadcast


class Length(construct.Adapter):  # type: ignore[misc]  # construct ships no types
    """The part that announces the data; it counts `also` bytes more than the data have."""

    @checked
    def __init__(self, subcon: Construct, also: Annotated[int, Meta(ge=-255, le=255)] = 0) -> None:
        super().__init__(subcon)
        self.also = also

    def _decode(self, obj: Any, context: Any, path: str) -> int:
        return int(obj - self.also)

    def _encode(self, obj: Any, context: Any, path: str) -> int:
        return int(obj + self.also)


class Same(construct.Subconstruct):  # type: ignore[misc]  # construct ships no types
    """The part of a reply that repeats the request's part `name`, with `plus` added to it.

    What does not fit into the type is cut off.
    """

    @checked
    def __init__(self, name: str, subcon: Construct, plus: Natural = 0) -> None:
        super().__init__(subcon)
        self.part = name
        self.plus = plus

    def _parse(self, stream: Any, context: Any, path: str) -> int:
        value = int(self.subcon._parsereport(stream, context, path))
        expected = self._repeated(context)
        if value != expected:
            raise construct.ValidationError(
                f"{self.part} is {value}, the request has {expected}", path
            )
        return value

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> int:
        value = self._repeated(context)
        self.subcon._build(value, stream, context, path)
        return value

    def _repeated(self, context: Any) -> int:
        value = context._params.asked[self.part] + self.plus
        width = (
            1 if isinstance(self.subcon, construct.BitsInteger) else 8
        )  # of what the type counts
        return int(value % (1 << width * self.subcon.sizeof()))


class Data(Construct):  # type: ignore[misc]  # construct ships no types
    """The data of a reply, as `answer=` of the instruction lays them out that was asked."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        answer = context._params.asked._answer
        return answer._parsereport(stream, context, path) if answer is not None else None

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        answer = context._params.asked._answer
        return answer._build(obj, stream, context, path) if answer is not None else None
