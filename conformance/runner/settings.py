"""Settings: whether a robot that was never seen moving moves with another speed, LED or steering.

Without motor power it moves in none. One that moves in one setting and not in another listens, and
does not obey: a failure that names both. Where the power can be switched, each setting is tried
right after power-on too, since a device that obeys nothing any more would show none.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from bilprov.analyzer.client.operations import Procedure, listen, power_cycle, send
from bilprov.conformance.cases.case import case_of_the_run, in_motion
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.homing import home, watch
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import fitted, movers, reached, setting
from bilprov.spec.protocol import Protocol

IDENT = "motion/settings"


class Setting(NamedTuple):
    """Frames that set a stopped robot moving, and what of them differs from the others, in words.

    `fresh` where it has just been switched on.
    """

    words: str
    frames: tuple[bytes, ...]
    fresh: bool = False


def settings(protocol: Protocol) -> Iterator[Setting]:
    """The first motion at full speed, then with each other setting, one at a time.

    Speeds and LED values go by bits; the plain one sets neither LED nor steering.
    """
    mover = next(iter(movers(protocol)), None)
    if mover is None:
        return
    car, fast = protocol.car, protocol.speeds[1]
    state = reached(protocol, in_motion(protocol, car.motion(mover.effect)))
    motion = fitted(protocol, mover, state)

    def at(variable: str, value: int) -> bytes:
        return setting(protocol, variable, value, state)

    full = at(car.speed, fast)
    for speed in (fast, *_by_bits(fast)):
        yield Setting(f"{car.speed} {speed}", (at(car.speed, speed), motion))
    for name in protocol.lights:
        low, high = protocol.limits.get(name, (0, 0))
        for value in (low, *_by_bits(high), high):
            yield Setting(f"{name} {value}", (full, at(name, value), motion))
    for steering in (0, *protocol.limits.get(car.steering, ())):
        yield Setting(f"{car.steering} {steering}", (full, motion, at(car.steering, steering)))


def _by_bits(high: int) -> list[int]:
    return [1 << bit for bit in range(high.bit_length()) if 1 << bit < high]


def other_settings(run: Run) -> Procedure[str | None]:
    """Try other settings with a robot that was not seen moving; a failure where they differ.

    Returns the motion in which it moves after all, None where it does not. Leaves the line homed.
    """
    for fresh in (False, True) if run.config.power else (False,):
        every = [
            one._replace(fresh=fresh) for one in settings(run.protocol) if _whole(run, one.frames)
        ]
        moves: Setting | None = None
        stands: Setting | None = None
        for one in every:
            moving = yield from _moves(run, one)
            if moving:
                moves = moves or one
            elif moving is False:
                stands = stands or one
            if moves and stands:
                break
        if moves is None:
            continue
        # Motor power that was switched on meanwhile, or noise, does not show the same again.
        stands = stands or every[0]._replace(fresh=False)
        if (yield from _moves(run, stands)) is False and (yield from _moves(run, moves)):
            _tell(run, moves, stands)
        elif fresh:
            yield from _switch(run)
        return run.protocol.car.motion(next(iter(movers(run.protocol))).effect)
    return None


def _whole(run: Run, frames: tuple[bytes, ...]) -> bool:
    """Whether the protocol has every frame of a setting, and the device takes it."""
    return all(frame and run.wire(frame) for frame in frames)


def _moves(run: Run, one: Setting) -> Procedure[bool | None]:
    """Whether it moves with a setting, None where that was not seen."""
    if one.fresh:
        yield from _switch(run)
    for frame in one.frames:
        yield from send(run.wire(frame))
        yield from run.waiting.answers(1)
    seen = yield from watch(run, moving=True)
    yield from home(run)
    return seen.look.moving


def _switch(run: Run) -> Procedure[None]:
    """Switch the robot off and on, and wait until it has booted."""
    yield from power_cycle()
    yield from listen(None, 2 * (run.profile.boot or 0) + run.timers.settle)
    yield from home(run)


def _tell(run: Run, moves: Setting, stands: Setting) -> None:
    after = " after power-on" if moves.fresh else ""
    reason = f"moves with {moves.words}{after}, not with {stands.words}"
    if moves.fresh and not stands.fresh:
        reason = f"moves with {moves.words}{after}, and no more with {stands.words} later"
    case = case_of_the_run(run.protocol, IDENT, b"".join(stands.frames))
    axis = Axis(Verdict.FAIL, "moving", "stopped", reason)
    run.conclude(case, {"state": axis})
