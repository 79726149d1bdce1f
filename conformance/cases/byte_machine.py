"""The Protocol as a Mealy machine over bytes: its states, and the classes of bytes they tell apart.

An input is a byte, or the silence that truncates a frame (between frames nothing is sent for as
long). An output is the answer and, at the end of a frame, what a probe shows of the motion. Of data
only the range and the sign count: speeds above zero are one class. The machine is explored from
these rules and minimised, and bytes that no state tells apart become one input. Every field
must be an integer of one byte.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from bilprov.conformance.cases.steps import Step, framed
from bilprov.conformance.machines.wp_method import Mealy, Output, explore, input_classes, minimal
from bilprov.spec.errors import UserError
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import Effect, State


@dataclass(frozen=True, slots=True)
class ByteMachine:
    """The minimal machine of a protocol, and the bytes of each input but the last, the silence.

    `variables` are those that count besides the kind of motion; in state 0 a speed is above zero,
    and every other variable zero.
    """

    machine: Mealy[Output]
    classes: tuple[tuple[int, ...], ...]
    variables: tuple[str, ...]

    @property
    def silence(self) -> int:
        """The number of the input that is no byte."""
        return len(self.classes)

    def input_of(self, byte: int) -> int:
        """The number of the input that a byte is."""
        return next(number for number, members in enumerate(self.classes) if byte in members)


@lru_cache(maxsize=8)
def byte_machine(protocol: Protocol, variables: tuple[str, ...] | None) -> ByteMachine:
    """The machine that answers alone show (`variables` None), or answers and motion.

    With motion, `variables` are those that are seen too; whether the speed is zero always counts,
    because it decides what moves. Raises UserError for a grammar with other fields than integers of
    one byte.
    """
    wide = next((f.name for s in protocol.instructions for f in s.fields if f.size > 1), "")
    if wide:
        raise UserError(
            f"the level complete takes fields of one byte, and {wide} has more: choose another "
            "level"
        )
    frames = _Frames(protocol)
    counted = () if variables is None else tuple(dict.fromkeys((protocol.car.speed, *variables)))
    bytes_of = input_classes(explore(None, 256, frames.take))
    silence = len(bytes_of)

    def step(
        at: tuple[_Position, State], symbol: int
    ) -> tuple[tuple[_Position, State], tuple[int | None, Hashable]]:
        position, robot = at
        if symbol == silence:
            position, end = None, frames.cut(position)
        else:
            position, end = frames.take(position, bytes_of[symbol][0])
        if end and variables is not None:
            effect = end.effect or protocol.on_fault
            robot = _signs(effect.apply(robot, dict(end.values)), counted)
        seen: Hashable = None
        if position is None and variables is not None:
            seen = visible_motion(robot), *(getattr(robot, name) for name in variables)
        return (position, robot), (end.code if end else None, seen)

    first: tuple[_Position, State] = None, _first(protocol, counted)
    whole = minimal(explore(first, silence + 1, step))
    classes = input_classes(whole.restricted(range(silence)))
    chosen = (*(members[0] for members in classes), silence)
    merged = tuple(tuple(sorted(b for one in ms for b in bytes_of[one])) for ms in classes)
    return ByteMachine(whole.restricted(chosen), merged, counted)


def _first(protocol: Protocol, variables: tuple[str, ...]) -> State:
    """The first state: stopped, at a speed above zero where one can be set."""
    at_rest = protocol.stop.effect.apply(protocol.power_on)
    speed = protocol.car.speed
    fast = protocol.limits.get(speed, (0, getattr(at_rest, speed)))[1]
    return _signs(at_rest.but(**{speed: fast}), variables)


def _signs(state: State, variables: tuple[str, ...]) -> State:
    """The state with each of these variables as its sign, and the others zero."""
    values = {name: getattr(state, name) for name in variables}
    signs = {name: (value > 0) - (value < 0) for name, value in values.items()}
    zero = {name: 0 for name in state.variables if name not in state.words}
    return state.but(**{**zero, **signs})


class _Faulty(NamedTuple):
    """In a frame that its header makes faulty: the code when complete, the one when truncated."""

    complete: int
    truncated: int
    missing: int


class _Data(NamedTuple):
    """In a frame of the right length: its header, and the classes of the data bytes so far."""

    header: int
    classes: tuple[int, ...]


_Position = _Faulty | _Data | None
"""The position in a frame; None between frames."""


class _End(NamedTuple):
    """The end of a frame: its answer, and its effect with the field values; None for a fault."""

    code: int
    effect: Effect | None = None
    values: tuple[tuple[str, int], ...] = ()


class _Frames:
    """How bytes lead through a frame; each position keeps an example of the bytes up to it."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._examples: dict[_Data, bytes] = {}
        self._ends: dict[_Data, _End] = {}

    def take(self, position: _Position, byte: int) -> tuple[_Position, _End | None]:
        """The position behind one byte more, and the end of the frame if that completes it."""
        if position is None:
            after = self._begun(byte)
        elif isinstance(position, _Faulty):
            after = position._replace(missing=position.missing - 1)
        else:
            after = self._more(position, byte)
        end = self._end(after)
        return (None if end else after), end

    def cut(self, position: _Position) -> _End | None:
        """The end of a frame that is truncated here; None between frames."""
        if position is None:
            return None
        if isinstance(position, _Faulty):
            return _End(position.truncated)
        identity, length = self._protocol.headers[position.header]
        return _End(_code(framed(self._protocol, identity, length, b"")))

    def _begun(self, header: int) -> _Faulty | _Data:
        protocol = self._protocol
        identity, length = protocol.headers[header]
        spec = protocol.by_id.get(identity)
        if spec is not None and spec.length == length:
            position = _Data(header, ())
            self._examples[position] = b""
            return position
        whole = framed(protocol, identity, length, bytes(length))
        cut = framed(protocol, identity, length, b"")
        return _Faulty(_code(whole), _code(cut), length)

    def _more(self, position: _Data, byte: int) -> _Data:
        spec = self._protocol.by_id[self._protocol.headers[position.header][0]]
        data = self._examples[position] + bytes([byte])
        field = next(field for field in spec.fields if field.offset == len(data) - 1)
        # A field's values are one class where they are alike in range and in sign.
        value = field.parse(bytes([byte]))
        kind = sum(value >= bound for bound in (field.low, 0, 1, field.high + 1))
        after = _Data(position.header, (*position.classes, kind))
        self._examples.setdefault(after, data)
        return after

    def _end(self, position: _Faulty | _Data) -> _End | None:
        if isinstance(position, _Faulty):
            return None if position.missing else _End(position.complete)
        if len(position.classes) < self._protocol.lengths[position.header]:
            return None
        if position not in self._ends:
            frame = self._examples[position]
            step = framed(self._protocol, *self._protocol.headers[position.header], frame)
            effect = step.frame_effect
            signs = ((name, (v > 0) - (v < 0)) for name, v in effect.values.items())
            self._ends[position] = _End(_code(step), effect.effect, tuple(signs))
        return self._ends[position]


def _code(step: Step) -> int:
    """The code of the expected answer."""
    return step.accepted[0].codes[0]
