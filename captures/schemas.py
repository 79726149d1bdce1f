"""The values stored in a capture: raw chunks and line events, and the values decoded from them.

Times in these values are integers in nanoseconds since the capture's start (monotonic), named `t`
or `end`. In the file the same moment is `log_time` = wall clock at the start + `t`. JSON lines and
CSV have seconds under the names `t` and `latency`; so these values, and the messages made of them,
have `t_ns` and `latency_ns` beside, which mean the same everywhere.
"""

from __future__ import annotations

import zlib
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self, TypeAlias

import msgspec

from bilprov.spec.state import State

Direction = Literal["host", "device"]
FrameKind = Literal["instruction", "response", "truncated", "garbage", "gap"]


class Timed(msgspec.Struct, frozen=True):
    """A value with its time `t` in nanoseconds since the capture's start."""

    t: int

    @property
    def t_ns(self) -> int:
        """The same as `t`, under the name that tells its unit."""
        return self.t


class Chunk(Timed, frozen=True, gc=False):
    """The bytes of one read from a port; all records are decoded from chunks."""

    direction: Direction
    data: bytes


class Line(Timed, frozen=True, gc=False):
    """Something that happened to a line and is not a byte (topic `/line`).

    `event` is `open`, `close`, `gap` (bytes are known to be lost), `break`, `parity`, `framing`,
    `overrun`, `modem`, `unplugged`, `reconnected` or `waited` (from `t` on nothing was
    read until the next event, because this program was stopped or had no time or a slow disk: when
    the bytes came is not known); `tap` says on which line, or is empty for both.
    """

    event: str
    tap: Direction | Literal[""] = ""
    detail: str = ""


class Instruction(Timed, frozen=True, gc=False):
    """Host bytes with their judgement (topic `/host/instructions`).

    `kind` is `instruction` for a whole frame, `truncated` for one that the time-out cut short,
    `garbage` for bytes that belong to no frame. `sequence` counts whole and truncated frames from
    0; garbage has none. `length` is what the header announces. `judgement` names the response that
    a conforming device gives.
    """

    end: int
    kind: FrameKind
    hex: str
    sequence: int | None
    id: int | None
    name: str | None
    length: int | None
    fields: dict[str, int]
    judgement: str | None
    reason: str


class FramedInstruction(Instruction, frozen=True, gc=False):
    """Host bytes of a protocol whose frames are more than a header byte and data.

    `address` is who is meant, where frames have an address. With `uncertain` the bytes may not be
    one frame, and `reason` has why. The others are as in an Instruction.
    """

    fields: dict[str, Any]
    address: int | None = None
    uncertain: bool = False


class Response(Timed, frozen=True, gc=False):
    """One device byte, with the instruction it answers (topic `/device/responses`).

    `instruction` is that instruction's `sequence` or None where there is none; `latency` is in
    nanoseconds from the instruction's last byte; `agrees` tells whether it is the response that the
    grammar expects, None where nothing is expected.
    """

    hex: str
    byte: int
    name: str | None
    instruction: int | None
    latency: int | None
    agrees: bool | None
    reason: str

    @property
    def latency_ns(self) -> int | None:
        """The same as `latency`, under the name that tells its unit."""
        return self.latency


class FramedResponse(Timed, frozen=True, gc=False):
    """One answer of several bytes, with the instruction it answers.

    `fields` are its data and `address` is whose it is, if it has one. With `uncertain` the bytes
    may not be one answer, and `reason` has why. The others are as in a Response.
    """

    hex: str
    name: str | None
    instruction: int | None
    latency: int | None
    agrees: bool | None
    reason: str
    fields: dict[str, Any]
    address: int | None = None
    uncertain: bool = False

    @property
    def latency_ns(self) -> int | None:
        """The same as `latency`, under the name that tells its unit."""
        return self.latency


class Time(msgspec.Struct, frozen=True):
    """A wall-clock moment as Foxglove writes it."""

    sec: int
    nsec: int


class Log(msgspec.Struct, frozen=True):
    """Something odd, in the shape of Foxglove's log message (topic `/faults`).

    `level` is 1 debug, 2 info, 3 warning, 4 error, 5 fatal; `name` is the kind of oddity.
    """

    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


class CaseMark(Timed, frozen=True):
    """The begin or the end of a conformance case (topic `/conformance/cases`)."""

    id: str
    phase: Literal["begin", "end"]
    verdict: str | None = None
    reason: str = ""


class Asked(Timed, frozen=True):
    """One thing that a conformance run asked for, written when it was done (`/conformance/asks`).

    What was sent, heard and seen stands in the messages before it; `t` is when it was done, of a
    `send` when the last byte had gone, `begun` when a `look` was asked for. `ended` says why it
    could not be done, or why the run was told to end (`interrupt`); then `error` tells that the
    kit, the port or the probe failed and `line_works` that the robot could still be homed. A port
    that was lost was missed at `lost` and there again at `t`; then the run went on.
    """

    ask: Literal["send", "listen", "look", "power", "interrupt"]
    begun: int | None = None
    ended: str | None = None
    error: bool | None = None
    line_works: bool | None = None
    lost: int | None = None


class Look(Timed, frozen=True):
    """One reading of the probe (topic `/conformance/looks`). None is what it cannot tell.

    A class that `look_class` makes has the variables of the state too, as they were set, and the
    speeds of a car's wheels. `variables` are these variables, `words` those of them that have
    words, `car` is what a car declares.
    """

    variables: ClassVar[tuple[str, ...]] = ()
    words: ClassVar[frozenset[str]] = frozenset()
    car: ClassVar[Any] = None

    moving: bool | None = None

    if TYPE_CHECKING:

        def __init__(
            self, t: int, moving: bool | None = None, *told: Any, **named: Any
        ) -> None: ...
        def __getattr__(self, name: str) -> Any: ...


@cache
def look_class(state: type[State]) -> type[Look]:
    """The class of the looks at devices that have these states."""
    values = [(name, str if name in state.words else int) for name in state.variables]
    wheels = [("left", int), ("right", int)] if state.wheels else []
    made: Any = msgspec.defstruct(
        "Look",
        [(name, kind | None, None) for name, kind in (*values, *wheels)],
        bases=(Look,),
        namespace={
            "__doc__": Look.__doc__,
            "variables": state.variables,
            "words": frozenset(state.words),
            "car": state.wheels,
        },
        frozen=True,
    )
    found: type[Look] = made
    return found


class Checkpoint(Timed, frozen=True):
    """What is needed to go on decoding after the messages before it (topic `/checkpoint`).

    `decoder` is the state as the decoder wrote it (JSON), in which nobody else looks; `grammar` is
    the sha256 of the grammar that it decoded by. `crc` is the CRC-32 of the UTF-8 text of `t`,
    `grammar` and `decoder`, a newline between them. `resumes` is true where the messages before it
    do not lead to that state, since some were left out (a `gap` right before it says how much) or
    the capture begins there: decoding then has to go on from it.
    """

    grammar: str
    decoder: str
    crc: int
    resumes: bool | None = None

    @classmethod
    def of(cls, t: int, grammar: str, decoder: str, resumes: bool | None = None) -> Self:
        """A checkpoint at `t` (ns) with its checksum."""
        return cls(t, grammar, decoder, _crc(t, grammar, decoder), resumes)

    @property
    def whole(self) -> bool:
        """Whether the checksum is right and the decoder's state is JSON."""
        if self.crc != _crc(self.t, self.grammar, self.decoder):
            return False
        try:
            msgspec.json.decode(self.decoder)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return False
        return True


class Message(NamedTuple):
    """One message of any topic, as stored; `t` is ns since the capture's start."""

    topic: str
    t: int
    data: bytes
    sequence: int


class Resumption(Line, frozen=True, kw_only=True):
    """A place from which decoding goes on in a known state; a reader gives it, no file holds it.

    It stands for a checkpoint that `resumes`, and for the `gap` right before it: what came in
    between was left out. With `silent` there is no gap: the capture begins there.
    """

    checkpoint: Checkpoint
    silent: bool = False

    @property
    def gap(self) -> Line:
        """The line event without the checkpoint, as a file holds it."""
        return Line(self.t, self.event, self.tap, self.detail)


Recorded: TypeAlias = Chunk | Line | Look | CaseMark | Asked | Checkpoint
"""What is recorded and not decoded from the bytes."""


def _crc(t: int, grammar: str, decoder: str) -> int:
    return zlib.crc32(f"{t}\n{grammar}\n{decoder}".encode("utf-8", "surrogatepass"))


MS = 1_000_000  # ns
