"""The sweeps of speed and steering in motion, by which the wheels' speeds are judged as numbers.

Which instruction sweeps what follows from its effect; a wide field is swept in even steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.oracle.state_model import NOTHING
from bilprov.conformance.oracle.wheel_curve import READING
from bilprov.spec.by_effect import movers, setters
from bilprov.spec.codec import build
from bilprov.spec.motion import Moment, State, moment_of
from bilprov.spec.protocol import InstructionSpec, Protocol

MOST_SETTINGS = 256
"""Settings of a sweep: a field that takes more values is swept in even steps."""
_WHAT = {
    "steering": "the wheels never differ less at a higher strength",
    "speed": "no wheel is slower at a higher speed",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelSweep(Case):
    """A sweep of `variable` while the robot drives, in the motion of its `setup`.

    `settings` are the values of the variable and the frames that set them, from the weakest to the
    strongest; `mover` is the frame of the motion. As many frames are counted, and none is listed.
    """

    variable: str
    settings: tuple[tuple[int, bytes], ...]
    mover: bytes

    @property
    def sent(self) -> tuple[bytes, ...]:
        """None: they follow from the id."""
        return ()

    @property
    def frames(self) -> int:
        """How many settings are swept."""
        return len(self.settings)


def wheel_sweeps(protocol: Protocol) -> tuple[WheelSweep, ...]:
    """The sweeps of a protocol; none where no instruction without data makes the robot drive.

    Steering comes first, whose curve shows whether a probe tells graded speeds at all.
    """
    short = (s for s in movers(protocol) if not s.fields)
    drive = next((s for s in short if moment_of(s.effect) is Moment.DRIVE), None)
    if drive is None:
        return ()
    # One that sets another variable too would change what is compared.
    alone = [spec for spec in setters(protocol) if len(spec.effect.assignments) == 1]
    speeds = [values for spec in alone for values in _sides(protocol, spec, "speed")]
    if not speeds:
        return ()
    found: dict[str, WheelSweep] = {}
    fast = speeds[0][-1][0]
    for spec in alone:
        for values in _sides(protocol, spec, "steering"):
            sweep = _sweep(protocol, drive, "steering", values, fast)
            found.setdefault(sweep.id, sweep)
    # The lowest that moves it: the wheels need not slow down before they are looked at.
    slow = next(value for value, _ in speeds[0] if value)
    sweep = _sweep(protocol, drive, "speed", speeds[0], slow)
    return (*found.values(), sweep)


def _sweep(
    protocol: Protocol,
    drive: InstructionSpec,
    variable: str,
    settings: list[tuple[int, bytes]],
    speed: int,
) -> WheelSweep:
    """The sweep of a variable over these settings, of a robot set to this speed first."""
    assert drive.effect.motion is not None
    side = "" if variable == "speed" else "-right" if settings[-1][0] > 0 else "-left"
    setup = State(drive.effect.motion, speed=speed)
    return WheelSweep(
        frame=settings[-1][1],
        kind=FrameClass.VALID,
        accepted=(),
        frame_effect=NOTHING,
        clause=protocol.clauses.instructions,
        reading=READING,
        id=f"wheels/{variable}{side}",
        requirement=_WHAT[variable],
        setup=setup,
        expected=setup,
        stop=False,
        variable=variable,
        settings=tuple(settings),
        mover=build(protocol, drive.name),
    )


def _sides(
    protocol: Protocol, spec: InstructionSpec, variable: str
) -> Iterator[list[tuple[int, bytes]]]:
    """The values that an instruction gives a variable, with its frames: positive, negative."""
    for name, source in spec.effect.assignments:
        if name != variable or not isinstance(source, tuple):
            continue
        field, factor = source
        part = next(f for f in spec.fields if f.name == field)
        rest = {f.name: f.low for f in spec.fields}
        for side in (1, -1) if variable == "steering" else (1,):
            # The field's values that steer to this side, or nowhere.
            low, high = part.low, part.high
            if side * factor > 0:
                low = max(low, 0)
            else:
                high = min(high, 0)
            if low > high or low == high == 0:
                continue
            values = sorted((n * factor for n in evenly(low, high, MOST_SETTINGS)), key=abs)
            yield [
                (value, build(protocol, spec.name, rest | {field: value // factor}))
                for value in values
            ]


def evenly(low: int, high: int, most: int) -> list[int]:
    """At most so many integers (two or more) from `low` to `high`, both included, evenly spaced."""
    count = min(most, high - low + 1)
    if count == 1:
        return [low]
    return [low + (high - low) * step // (count - 1) for step in range(count)]
