"""The sweeps of speed and steering in motion, by which the wheels' speeds are judged as numbers.

Which instruction sweeps what follows from its effect; a wide field is swept in even steps.
"""

from __future__ import annotations

from dataclasses import dataclass

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.oracle.state_model import NOTHING
from bilprov.conformance.oracle.wheel_curve import READING
from bilprov.spec.by_effect import movers, setting
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
    speeds = _settings(protocol, "speed", 1)
    if drive is None or not speeds:
        return ()
    # The lowest that moves it: the wheels need not slow down before they are looked at.
    slow, fast = next(value for value, _ in speeds if value), speeds[-1][0]
    sides = filter(None, (_settings(protocol, "steering", side) for side in (1, -1)))
    found = [_sweep(protocol, drive, "steering", values, fast) for values in sides]
    return (*found, _sweep(protocol, drive, "speed", speeds, slow))


def _settings(protocol: Protocol, variable: str, side: int) -> list[tuple[int, bytes]]:
    """The values of a variable on one side of 0, with the frames that set them.

    None where an instruction sets another variable too, which would change what is compared.
    """
    low, high = protocol.limits.get(variable, (0, 0))
    low, high = (max(low, 0), high) if side > 0 else (low, min(high, 0))
    values = sorted(evenly(low, high, MOST_SETTINGS), key=abs) if low < high else []
    found = [(value, frame) for value in values if (frame := setting(protocol, variable, value))]
    specs = {protocol.by_id[protocol.headers[frame[0]][0]] for _, frame in found}
    return found if all(len(spec.effect.assignments) == 1 for spec in specs) else []


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


def evenly(low: int, high: int, most: int) -> list[int]:
    """At most so many integers (two or more) from `low` to `high`, both included, evenly spaced."""
    count = min(most, high - low + 1)
    if count == 1:
        return [low]
    return [low + (high - low) * step // (count - 1) for step in range(count)]
