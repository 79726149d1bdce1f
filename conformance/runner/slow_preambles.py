"""The preamble speed: the lowest at which the probe sees the robot, twice over, for most faults.

Most cases need a robot that is seen moving, not a fast one. The lowest of a few speeds at which
every kind of motion is seen is found once, and twice that speed is used, so that a motor that has
become warm, or a battery that has become weak, still turns the wheels. Where the wheels do not turn
at it later, the case is made again at the speed that it names itself, and all after it keep theirs:
no verdict rests on a motor's dead zone.
"""

from __future__ import annotations

from collections.abc import Iterator

from bilprov.analyzer.client.operations import Procedure
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.preamble import in_motion
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.runner.homing import SetUp, home, set_up, watch
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import setting
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

_PARTS = (16, 8, 4)  # of the greatest speed; twice the last is the slowest that a case names
_MARGIN = 2


def speeds(protocol: Protocol) -> Iterator[int]:
    """The speeds that are tried, from the lowest on; none where no instruction sets a speed."""
    _, fast = protocol.speeds
    for part in _PARTS:
        speed, name = fast // part, protocol.car.speed
        if speed and all(setting(protocol, name, n) for n in (speed, _MARGIN * speed)):
            yield speed


def find_speed(run: Run) -> Procedure[None]:
    """Find the preamble speed, for a homed robot whose motions are known; leaves the line homed."""
    if not run.config.slow_preambles or not run.config.observable:
        return
    motions = sorted(run.profile.moves or ())
    for speed in speeds(run.protocol) if motions else ():
        for motion in motions:
            if not (yield from _seen(run, in_motion(run.protocol, motion, speed))):
                break
        else:
            run.profile.preamble_speed = _MARGIN * speed
            return


def _seen(run: Run, state: State) -> Procedure[bool | None]:
    """Whether a homed robot moves in a state; None where it was not seen, or perhaps not told."""
    ready = yield from set_up(run, state)
    seen = yield from watch(run, moving=True, patience=run.timers.deadline)
    yield from home(run)
    return None if ready.missing and not seen.look.moving else seen.look.moving


def was_too_slow(run: Run, case: Case) -> Procedure[bool]:
    """Whether the robot moves at the speed of a failed case and not at that of its preamble.

    The preamble speed is then given up: the case has to be made again. Leaves the line homed.
    """
    slower = preamble_of(run, case)
    if slower == case.setup or (yield from _seen(run, slower)) is not False:
        return False
    if not (yield from _seen(run, case.setup)):
        return False
    run.profile.preamble_speed = None
    return True


def set_up_slowly(run: Run, state: State) -> Procedure[SetUp]:
    """Bring a homed robot to a state, at the preamble speed where it is seen moving at that."""
    slow, car = run.profile.preamble_speed, run.protocol.car
    if slow is not None and slow < car.drive(state).speed:
        ready = yield from set_up(run, state.but(**{car.speed: slow}))
        seen = yield from watch(run, moving=True, patience=run.timers.deadline)
        if seen.look.moving is not False:
            return ready
        run.profile.preamble_speed = None
        yield from home(run)
    return (yield from set_up(run, state))


def preamble_of(run: Run, case: Case) -> State:
    """The state in which a case begins with this robot: as it names it, or slower.

    Slower are the cases in which a fault must stop the robot. The first of each class of fault in
    each kind of motion keeps its speed, since a fast robot is harder to stop; so does a case of a
    valid frame, after which the wheels must be seen to turn at their speeds.
    """
    slow = run.profile.preamble_speed
    slows = case.faulty and case.stop and not case.thorough and case.kind is not FrameClass.VALID
    car = run.protocol.car
    motion, speed, _ = car.drive(case.setup)
    if slow is None or not slows or motion not in (run.profile.moves or ()):
        return case.setup
    return case.setup.but(**{car.speed: min(slow, speed)})
