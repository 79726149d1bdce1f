"""The machine of the Protocol over the inputs of learning.

Inputs are every instruction with representative data and every kind of fault. An output of a device
after one input is its answers, and what the probe then sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from bilprov.captures.schemas import Look, look_class
from bilprov.conformance.cases.frame_source import fill
from bilprov.conformance.cases.steps import Step, framed, frames_of, open_frames, step_of
from bilprov.conformance.machines.wp_method import Mealy, explore
from bilprov.conformance.oracle.judge import answer_words
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.spec.by_effect import frames_to
from bilprov.spec.codec import bad_data, judge, spaced
from bilprov.spec.motion import Wheels, visible_motion
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State


@lru_cache(maxsize=1 << 3)
def alphabet(protocol: Protocol) -> tuple[Step, ...]:
    """Every input that is learned, each frame once; a machine's inputs are their indices.

    An instruction with data comes with its first and its last, bits with names with the last but
    one; bad data are the first and the last out of range. Each instruction is also sent with a data
    byte too many and one too few. A truncated frame is a header without its data, followed by the
    time-out.
    """
    steps = [step for spec in protocol.instructions for step in _ends(protocol, spec)]
    for turn, spec in enumerate(protocol.instructions):
        for length in (spec.length - 1, spec.length + 1):
            if length in protocol.data_lengths:
                steps.append(framed(protocol, spec.id, length, fill(protocol, length, turn)))
        bad = list(bad_data(spec))
        steps += (framed(protocol, spec.id, spec.length, d) for d in (*bad[:1], *bad[-1:]))
    for turn, identity in enumerate((*protocol.unused_ids[:1], *protocol.unused_ids[-1:])):
        steps.append(framed(protocol, identity, turn, fill(protocol, turn, 1)))
    steps += open_frames(protocol).values()
    return tuple({step.frame: step for step in steps}.values())


def _ends(protocol: Protocol, spec: InstructionSpec) -> Iterator[Step]:
    """The instruction with its first and its last data."""
    steps = list(frames_of(protocol, spec.name))
    # Of bits with names not all are set: their order shows, and a bit that is stuck.
    bits = any(part.bits for part in spec.fields) and len(steps) > 2
    yield from (steps[0], steps[-2 if bits else -1])


def name_of(protocol: Protocol, step: Step) -> str:
    """An input in words: `Speed speed=255`, `unused 9, 2 data bytes (92 00 00)`."""
    words = judge(protocol, step.frame).describe()
    return f"{words} ({spaced(step.frame)})" if step.faulty and len(step.frame) > 1 else words


def item_of(protocol: Protocol, frame: bytes) -> str:
    """A frame as `bilprov send` takes it: an instruction with its values, else hex."""
    judged = judge(protocol, frame)
    if not judged.valid:
        return frame.hex()
    return " ".join((judged.name, *(str(value) for _, value in judged.fields)))


def rest_of(protocol: Protocol) -> State:
    """The state in which a sequence of inputs begins: stopped, each variable nearest to zero."""
    rest = {name: max(low, min(0, high)) for name, (low, high) in protocol.limits.items()}
    return protocol.state(**{protocol.car.by: protocol.car.still}, **rest)


def reset(protocol: Protocol) -> tuple[bytes, ...]:
    """The frames before each sequence of inputs. Homing keeps what a stop keeps."""
    return frames_to(protocol, rest_of(protocol))


FACETS = ("moving", "motion", "ahead", "lights")
"""What a look can show, each a facet of an output."""


def facet_words(protocol: Protocol, facet: str) -> str:
    """What a facet tells, in words."""
    known = {"moving": "whether it moves", "motion": "its motion", "ahead": "its wheels"}
    return known.get(facet, " and ".join(protocol.lights))


class Output(NamedTuple):
    """Answer codes, and the facets of a look; None is what is not seen or, if expected, not known.

    `motion` is the kind of motion, `ahead` the wheel that turns faster in a drive (`left`, `right`,
    or `alike`): no mixing law is given, so speeds count by sign and order only. `lights` are the
    values that do not change how it drives, by name.
    """

    codes: tuple[int, ...]
    moving: bool | None = None
    motion: str | None = None
    ahead: str | None = None
    lights: tuple[tuple[str, int], ...] | None = None

    def fits(self, other: Output) -> bool:
        """Whether both are equal in their answers and in every facet that both have."""
        return self == other or self.beside(other) == other.beside(self)

    def beside(self, other: Output) -> Output:
        """This output with only those facets that the other has too."""
        return self.without(name for name in FACETS if getattr(other, name) is None)

    def without(self, facets: Iterable[str]) -> Output:
        """This output with these facets not seen."""
        return self._replace(**dict.fromkeys(facets))  # type: ignore[arg-type]  # each may be None

    @property
    def motion_words(self) -> str:
        """The kind of motion, else whether it moves: `forward`, `moving`; "" where not seen."""
        if self.motion or self.moving is None:
            return self.motion or ""
        return "moving" if self.moving else "stopped"

    @property
    def look_words(self) -> str:
        """The look in few words: `forward, left wheel ahead, led 7`; "" where nothing is seen."""
        ahead = f"{self.ahead} wheel ahead" if self.ahead in ("left", "right") else ""
        lights = (f"{name} {value}" for name, value in self.lights or ())
        return ", ".join(filter(None, (self.motion_words, ahead, *lights)))

    def words(self, protocol: Protocol) -> str:
        """The whole output in words: `00 OK; forward, led 0`."""
        return "; ".join(filter(None, (answer_words(protocol, self.codes), self.look_words)))


def output_of(protocol: Protocol, codes: tuple[int, ...], look: Look | None) -> Output:
    """The output for these answers and this look; None where the robot was not looked at."""
    if look is None:
        return Output(codes)
    # A probe may name the direction that is set although speed 0 keeps the wheels still.
    car = protocol.car
    motion, ahead = car.drive(look).motion, None
    if look.moving is False and motion is not None:
        motion = car.still
    if look.left is not None and look.right is not None:
        turning, ahead = _turning(car, look.left, look.right)
        motion = turning if motion in (None, turning) else f"{motion}, by its wheels {turning}"
    lights = ((name, getattr(look, name)) for name in protocol.lights)
    shown = tuple((name, value) for name, value in lights if value is not None)
    return Output(codes, look.moving, motion, ahead, shown or None)


def _turning(car: Wheels, left: int, right: int) -> tuple[str, str | None]:
    """The kind of motion that the wheels' speeds show, and in a drive the wheel that is ahead."""
    motions = {both: motion for motion, both in car.turns.items()}
    slow, fast = sorted((abs(left), abs(right)))
    if not fast:
        return car.still, None
    turning, onward = (_sign(left), _sign(right)), (_sign(left + right),) * 2
    if left * right < 0 and 2 * slow >= fast:
        return motions.get(turning, "moving"), None
    ahead = "alike" if slow == fast else "left" if abs(left) == fast else "right"
    return motions.get(onward, "moving"), ahead


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


def _shows(protocol: Protocol, variable: str) -> tuple[str, ...]:
    """The facets that depend on a variable; a robot that stands still shows no speed."""
    car = protocol.car
    depend = {car.speed: ("moving", "motion", "ahead"), car.by: ("motion", "ahead")}
    return {**depend, car.steering: ("ahead",)}.get(variable, ("lights",))


def reference_machine(model: Model, steps: Sequence[Step]) -> Mealy[Output]:
    """The machine that a device must be which makes the model's choices; it may not be minimal.

    Facets of an output that the model does not know are None.
    """
    protocol = model.protocol
    start = model.homed(model.found())
    for frame in reset(protocol):
        start = model.after(start, step_of(protocol, frame).frame_effect)

    def step(before: ExpectedState, letter: int) -> tuple[ExpectedState, Output]:
        one = steps[letter]
        after = replace(model.after(before, one.frame_effect), rests_on=frozenset())
        return after, _expected(model, one, after)

    return explore(replace(start, rests_on=frozenset()), len(steps), step)


def _expected(model: Model, step: Step, after: ExpectedState) -> Output:
    word = model.choices.word(step.point) if step.point else ""
    accepted = next((one for one in step.accepted if one.word == word), step.accepted[0])
    state, protocol = after.state, model.protocol
    left, right = protocol.car.wheels(state, protocol.full_steering)
    values = {name: getattr(state, name) for name in protocol.lights}
    values[protocol.car.by] = visible_motion(state)
    looks = look_class(protocol.state_type)
    look = looks(t=0, moving=state.moving, left=left, right=right, **values)
    unknown = after.unknown - {protocol.car.speed} if after.still else after.unknown
    hidden = (facet for variable in unknown for facet in _shows(protocol, variable))
    return output_of(protocol, accepted.codes, look).without(hidden)
