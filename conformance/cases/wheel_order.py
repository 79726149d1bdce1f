"""A few settings of speed and of steering in motion, at which the wheels' order is judged."""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.conformance.cases.case import Case, in_motion
from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.oracle.state_model import NOTHING
from bilprov.spec.by_effect import movers, setting
from bilprov.spec.codec import build
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

READING = "R-resolution"
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
            Step(last, FrameClass.VALID, (), NOTHING, clause, reading=READING),
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
