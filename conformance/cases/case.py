"""A single-frame test case as a value, the states in which cases begin and the steps to them.

Also the cases on the order of the wheels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

from bilprov.conformance.cases.steps import FrameClass, Step, step_of
from bilprov.conformance.oracle.state_model import NOTHING
from bilprov.spec.by_effect import frames_to, movers, reached, setting
from bilprov.spec.codec import build
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State


@dataclass(frozen=True, slots=True, kw_only=True)
class Case(Step):
    """A test case: a step that is sent in a given state, its answer and the state judged.

    `setup` is the state the robot is brought to (and, where it moves, seen to move in) before the
    frame is sent; `expected` is the reference's state after it, and `stop` whether the case tests
    that the robot stands still. `then` is a valid frame that must work right after the stimulus.
    `short` frames announce less data than the instruction takes: a device must not take the next
    byte for its data. `thorough` cases wait for silence, one of each class for long; where looks
    are costly, only they are observed.
    """

    id: str
    requirement: str
    setup: State
    expected: State
    stop: bool
    then: bytes = b""
    short: bool = False
    thorough: bool = False

    @classmethod
    def of(cls, step: Step, **more: Any) -> Self:
        """The case that sends this step; `more` are the fields that a step has not."""
        return cls(**{field.name: getattr(step, field.name) for field in fields(Step)}, **more)

    def adapted(self, step: Case) -> Case:
        """The case as it is sent to a device; it keeps its clause and its reading."""
        stop = self.stop and step.faulty if self.faulty else self.stop or step.faulty
        return replace(step, clause=self.clause, reading=self.reading, stop=stop)

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The frames under test: the stimulus and, if there is one, `then`; not the preamble."""
        return (self.frame, self.then) if self.then else (self.frame,)

    @property
    def frames(self) -> int:
        """How many frames are under test."""
        return len([frame for frame in self.sent if frame])


def runner_case(
    protocol: Protocol,
    ident: str,
    clause: str,
    requirement: str,
    frame: bytes,
    reading: str = "",
) -> Case:
    """A case that a procedure of the runner carries out; it states no answers or effect."""
    rest = protocol.power_on
    step = Step(frame, FrameClass.VALID, (), NOTHING, clause, reading=reading)
    return Case.of(step, id=ident, requirement=requirement, setup=rest, expected=rest, stop=False)


OF_THE_RUN = {
    "line/probe": ("safety", "the probe shows what the robot does"),
    "line/unsolicited": ("responses", "answers only when it is asked"),
    "line/lost": ("responses", "answers between the cases too"),
    "line/pipelining": ("responses", "instructions sent ahead are answered too", "R-pipelining"),
    "power-on/lost": ("responses", "the first instructions are answered too", "R-power-on"),
    "power-on/first-fault": ("safety", "the first fault stops the robot too"),
    "motion/settings": ("instructions", "moves in every setting"),
    "leave/stopped": ("safety", "the run leaves the robot at rest"),
}
"""The cases of what is seen between the others: clause, requirement and, for some, the reading."""


def case_of_the_run(protocol: Protocol, ident: str, frame: bytes = b"") -> Case:
    """The case of that id among OF_THE_RUN; `frame` is what was sent."""
    clause, requirement, *reading = OF_THE_RUN[ident]
    section = getattr(protocol.clauses, clause)
    return runner_case(protocol, ident, section, requirement, frame, *reading)


def full_state(protocol: Protocol, mover: InstructionSpec) -> State:
    """A state in a motion, with every variable far from its value at rest."""
    car = protocol.car
    ends = {
        # To the right where it steers both ways, and no speed backward.
        name: high if name == car.speed else max(high, low, key=abs)
        for name, (low, high) in protocol.limits.items()
    }
    motion = car.motion(mover.effect) or car.still
    return reached(protocol, protocol.state(**ends, **{car.by: motion}))


def in_motion(
    protocol: Protocol,
    motion: str | None,
    speed: int | None = None,
    lights: Mapping[str, int] | None = None,
) -> State:
    """A robot's state straight on in a motion (None: it stands), at the greatest speed or this."""
    car, fast = protocol.car, protocol.speeds[1]
    driving = {car.by: motion or car.still, car.speed: fast if speed is None else speed}
    return protocol.state(**driving, **(lights or {}))


def steps_to(protocol: Protocol, state: State, known: State | None = None) -> tuple[Step, ...]:
    """The fewest instructions that bring a robot to a state, see `frames_to`."""
    return tuple(step_of(protocol, frame) for frame in frames_to(protocol, state, known))


def state_after(protocol: Protocol, state: State, step: Step) -> State:
    """The reference's state after a step."""
    return (step.frame_effect.effect or protocol.on_fault).apply(state, step.frame_effect.values)


# -- the wheels' order at a few settings of speed and of steering in motion -----------------------


RESOLUTION = "R-resolution"
# Of the greatest value: whichever of them is halved is less than the one before it.
_SIXTEENTHS = (2, 3, 4, 6, 8, 12, 16)
_STEERING = "the wheels never differ less at a stronger steering"
_SPEED = "no wheel is slower at a higher speed, and half speed is slower than full"


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderCase(Case):
    """The wheels' order at values of `variable`, in the motion of the case's `setup`.

    `settings` are the values and the frames that set them, in ascending order; `mover` is the frame
    of the motion.
    """

    variable: str
    settings: tuple[tuple[int, bytes], ...]
    mover: bytes

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The frames of the settings."""
        return tuple(frame for _, frame in self.settings)


def wheel_orders(protocol: Protocol) -> tuple[OrderCase, ...]:
    """The cases of a protocol; none where no instruction without data makes the robot drive.

    Steering comes first: it shows whether a probe tells graded speeds at all.
    """
    car = protocol.car
    straight = (s for s in movers(protocol) if car.moment(s.effect) is Moment.DRIVE)
    drive = next((spec for spec in straight if not spec.fields), None)
    speeds = [value for value, _ in _settings(protocol, car.speed, protocol.power_on)]
    if drive is None or len(speeds) < 2:
        return ()
    cases = []
    # At the lowest that moves it the wheels need not slow down before they are looked at.
    slow, *_, fast = *filter(None, speeds), speeds[-1]
    for variable, requirement, speed in (
        (car.steering, _STEERING, fast),
        (car.speed, _SPEED, slow),
    ):
        setup = in_motion(protocol, car.motion(drive.effect), speed)
        settings = _settings(protocol, variable, setup)
        if len(settings) < 2:
            continue
        _, last = settings[-1]
        clause = protocol.clauses.instructions
        case = OrderCase.of(
            Step(last, FrameClass.VALID, (), NOTHING, clause, reading=RESOLUTION),
            id=f"wheels/{variable}",
            requirement=requirement,
            setup=setup,
            expected=setup,
            stop=False,
            variable=variable,
            settings=settings,
            mover=build(protocol, drive.name),
        )
        cases.append(case)
    return tuple(cases)


def _settings(protocol: Protocol, variable: str, beside: State) -> tuple[tuple[int, bytes], ...]:
    """The values that an instruction can set, with its frames."""
    low, high = protocol.limits.get(variable, (0, 0))
    most = max(abs(low), high)
    sizes = (0, 1, *(most * part // 16 for part in _SIXTEENTHS))
    values = {low, high, *sizes, *(-size for size in sizes)}
    within = (value for value in sorted(values) if low <= value <= high)
    frames = ((value, setting(protocol, variable, value, beside)) for value in within)
    return tuple((value, frame) for value, frame in frames if frame)
