"""A few settings of speed and of steering in motion, at which the wheels' order is judged."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.preamble import in_motion
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.oracle.state_model import NOTHING
from bilprov.conformance.oracle.wheel_order import READING
from bilprov.spec.by_effect import movers, setting
from bilprov.spec.codec import build
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State

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
    car, short = protocol.car, (spec for spec in movers(protocol) if not spec.fields)
    drive = next((s for s in short if car.moment(s.effect) is Moment.DRIVE), None)
    speeds = [value for value, _ in _settings(protocol, car.speed, protocol.power_on)]
    if drive is None or len(speeds) < 2:
        return ()
    # At the lowest that moves it the wheels need not slow down before they are looked at.
    slow, fast = (next(filter(None, values)) for values in (speeds, reversed(speeds)))
    cases = (
        _case(protocol, drive, car.steering, _STEERING, fast),
        _case(protocol, drive, car.speed, _SPEED, slow),
    )
    return tuple(case for case in cases if len(case.settings) > 1)


def _case(
    protocol: Protocol, drive: InstructionSpec, variable: str, requirement: str, speed: int
) -> OrderCase:
    """The case about a variable of a robot that is set to this speed first."""
    setup = in_motion(protocol, protocol.car.motion(drive.effect), speed)
    settings = _settings(protocol, variable, setup)
    clause, last = protocol.clauses.instructions, settings[-1][1] if settings else b""
    step = Step(last, FrameClass.VALID, (), NOTHING, clause, reading=READING)
    return OrderCase.of(
        step,
        id=f"wheels/{variable}",
        requirement=requirement,
        setup=setup,
        expected=setup,
        stop=False,
        variable=variable,
        settings=settings,
        mover=build(protocol, drive.name),
    )


def _settings(protocol: Protocol, variable: str, beside: State) -> tuple[tuple[int, bytes], ...]:
    """The values that an instruction can set, with its frames."""
    low, high = protocol.limits.get(variable, (0, 0))
    most = max(abs(low), high)
    sizes = (0, 1, *(most * part // 16 for part in _SIXTEENTHS))
    values = sorted({low, high, *(size * side for size in sizes for side in (-1, 1))})
    frames = (
        (value, setting(protocol, variable, value, beside))
        for value in values
        if low <= value <= high
    )
    return tuple((value, frame) for value, frame in frames if frame)
