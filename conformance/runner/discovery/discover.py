"""Discovers a device's choices by short experiments on each open point of the document.

An experiment is repeated until its findings agree (`runner.retry.agree`); from then on the device
is held to that choice. It is a case (`reading/...`) with the verdict that the readings give to the
choice. Those on the state after a frame stand here, those on answers in `answers`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from operator import attrgetter

from bilprov.analyzer.client.operations import Procedure, Received, listen, observe, send
from bilprov.captures.schemas import MS, Look
from bilprov.captures.text import quantity
from bilprov.conformance.cases.case import Case, case_of_the_run, full_state, runner_case
from bilprov.conformance.cases.steps import code_of, one_of_each, step_of
from bilprov.conformance.oracle.judge import differences, look_words
from bilprov.conformance.oracle.profile import verdict_of
from bilprov.conformance.oracle.verdicts import Axis, Verdict
from bilprov.conformance.runner.discovery.answers import Experiment, Finding, answer_experiments
from bilprov.conformance.runner.homing import home, set_up, set_up_slowly, watch
from bilprov.conformance.runner.power_on import first_frames_lost
from bilprov.conformance.runner.retry import AGREE, agree, may_be_noise
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import fitted, movers, moving_to, setting
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Moment
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.readings import FLUSH_POINTS, POINTS, Behaviour, OpenPoint, open_after
from bilprov.spec.state import Effect, State

# -- experiments on the robot's state after a frame -----------------------------------------------
# `first_choices` records what a device chooses in its first frames after power-on, before the
# stops of homing reset the state: one that chooses otherwise later contradicts itself.


_LOOK = 50 * MS  # between two looks while the line is silent
_AGAIN = 500 * MS  # how long a robot that stopped by itself is observed


def state_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Every experiment that needs looks."""
    able = [spec for spec in movers(protocol) if full_state(protocol, spec).moving]
    car = protocol.car
    straight = [s for s in able if car.moment(s.effect) is Moment.DRIVE]
    turning = [s for s in able if car.moment(s.effect) is Moment.ROTATION]
    if not straight:
        return
    first = straight[0]
    full = full_state(protocol, first)
    for kind in filter(None, (straight, turning)):
        last = kind[-1]
        point = _points(protocol, last.effect, full).get(car.steering)
        if point:
            yield _probe(
                point.id.removeprefix("R-"),
                (point,),
                f"{last.name} keeps the steering",
                partial(_move_on, first=first, last=last, point=point),
                protocol.header_bytes[last.id, last.length],
            )
    stop = bytes([protocol.header_bytes[protocol.stop.id, 0]])
    points = _points(protocol, protocol.stop.effect, full)
    yield _probe(
        "after-stop",
        points.values(),
        f"{protocol.stop.name} resets the directions and keeps speed and LED",
        partial(_after, first=first, frame=stop, points=points),
        stop[0],
    )
    fault = next(iter(one_of_each(protocol).values())).frame
    points = _points(protocol, None, full)
    yield _probe(
        "after-fault",
        points.values(),
        "a fault resets what a stop does and keeps speed and LED",
        partial(_after, first=first, frame=fault, points=points),
        fault[0],
    )
    if setting(protocol, car.speed, 0, full):
        yield _probe(
            "speed-moving",
            (POINTS["R-speed-moving"],),
            "a speed takes effect at once",
            partial(_speed_moving, first=first),
            setting(protocol, car.speed, 0, full)[0],
        )
    if turning and _steers(protocol, turning[0]):
        yield _probe(
            "steer-rotating",
            (POINTS["R-steer-rotating"],),
            "steering during a rotation does not end it",
            partial(_steer_rotating, turning=turning[0]),
            protocol.header_bytes[turning[0].id, turning[0].length],
        )
    yield Experiment(
        "watchdog",
        ("R-watchdog",),
        "keeps driving while the line is silent, and sends nothing by itself",
        partial(_watchdog, first=first),
        bytes([protocol.header_bytes[first.id, first.length]]),
        sees=True,
        safety=True,
        long=True,
    )


def _probe(
    name: str,
    points: Iterable[OpenPoint],
    requirement: str,
    make: Callable[[Run], Procedure[Finding]],
    header: int,
) -> Experiment:
    ids = tuple(point.id for point in points)
    return Experiment(name, ids, requirement, make, bytes([header]), sees=True, safety=True)


def _steers(protocol: Protocol, turning: InstructionSpec) -> bytes:
    """The frame that steers a robot that rotates at full speed, b"" if there is none."""
    full, name = full_state(protocol, turning), protocol.car.steering
    return setting(protocol, name, getattr(full, name), full)


def _points(protocol: Protocol, effect: Effect | None, full: State) -> dict[str, OpenPoint]:
    """The points that an effect, None for a fault, leaves open, in the order of their judgement.

    They are about variables that the protocol sets, and that are not 0 in the state before.
    """
    points, car = open_after(protocol, effect), protocol.car
    names = (car.steering, car.speed, *protocol.lights)
    judged = [name for name in names if name in protocol.limits and getattr(full, name)]
    return {name: points[name] for name in judged if name in points}


def _send(run: Run, frame: bytes) -> Procedure[int]:
    """Send a frame and wait for its answer; returns how many answers came."""
    yield from send(frame)
    heard = yield from run.waiting.answers(1)
    return len(heard.answers)


def _compared(protocol: Protocol, name: str, before: Look, look: Look, full: State) -> str:
    """What a look shows of a variable: kept as in `full`, reset, "" if it is not seen.

    One that was not as in `full` when it was looked at `before` shows nothing.
    """
    wanted, was, value = getattr(full, name), getattr(before, name), getattr(look, name)
    if was not in (None, wanted):
        return f"{protocol.noun(name)} was {was} before, expected {wanted}"
    known = {None: "", wanted: Behaviour.KEPT, 0: Behaviour.RESET}
    return known.get(value, f"{protocol.noun(name)} is {value}")


def _steering(protocol: Protocol, before: Look, look: Look, full: State) -> str:
    """What a moving robot's steering shows: kept, reset, "" if it cannot be told."""
    name = protocol.car.steering
    if getattr(look, name) is not None:
        return _compared(protocol, name, before, look, full)
    if look.left is None or look.right is None or not look.moving:
        return ""
    return Behaviour.RESET if look.left == look.right else Behaviour.KEPT


def _move_on(
    run: Run, *, first: InstructionSpec, last: InstructionSpec, point: OpenPoint
) -> Procedure[Finding]:
    """Find out what another motion instruction, `last`, leaves of the steering."""
    full, car = full_state(run.protocol, first), run.protocol.car
    lost = (yield from set_up(run, full)).missing
    before = (yield from observe()).look
    yield from _send(run, fitted(run.protocol, last, full))
    look = (yield from watch(run, moving=True)).look
    actual, blind = look_words(look), False
    unseen = car.drive(look).steering is None
    if unseen and car.moment(last.effect) is Moment.ROTATION:
        # The wheels of a rotation do not show the steering: it shows when the robot drives again.
        yield from _send(run, fitted(run.protocol, first, full))
        look = (yield from watch(run, moving=True)).look
        actual += f"; driving again: {look_words(look)}"
        blind = _straightens(run, first)
    word = "" if blind else point.word_of(_steering(run.protocol, before, look, full))
    return Finding(((point.id, word),), "steering kept", actual, lost)


def _straightens(run: Run, first: InstructionSpec) -> bool:
    """Whether driving again with this instruction does not show what the steering was."""
    steers = first.effect.sets(run.protocol.car.steering)
    return steers or run.profile.choices.differs("R-drive-steering")


def _after(
    run: Run, *, first: InstructionSpec, frame: bytes, points: Mapping[str, OpenPoint]
) -> Procedure[Finding]:
    """Find out what a frame that stops the robot leaves of steering, speed and LED."""
    protocol, car = run.protocol, run.protocol.car
    full = full_state(protocol, first)
    again_frame = fitted(protocol, first, full)
    lost = (yield from set_up(run, full)).missing
    before = (yield from watch(run, moving=True)).look
    yield from _send(run, frame)
    seen = yield from watch(run, moving=False)
    look, actual = seen.look, look_words(seen.look)
    fault = lost or ("still moves" if look.moving else "")
    yield from listen(None, run.waiting.idle if run.profile.flushes else 0)
    again = look
    _, speed_seen, steering_seen = car.drive(look)
    if speed_seen is None or steering_seen is None:
        # What the probe does not tell shows when the robot drives again.
        yield from _send(run, again_frame)
        again = (yield from watch(run, moving=True)).look
        actual += f"; driving again: {look_words(again)}"
    speed_again = again
    speed_frame = setting(protocol, car.speed, car.drive(full).speed, full)
    if again.moving is False and steering_seen is None and speed_frame:
        # Its speed was zeroed; with a new one its steering shows.
        yield from _send(run, speed_frame)
        yield from _send(run, again_frame)
        again = (yield from watch(run, moving=True)).look
    seen_now = {name: _compared(protocol, name, before, look, full) for name in protocol.settings}
    if steering_seen is None:
        blind = _straightens(run, first)
        seen_now[car.steering] = "" if blind else _steering(protocol, before, again, full)
    if speed_seen is None:
        moving = speed_again.moving
        seen_now[car.speed] = {None: "", True: Behaviour.KEPT, False: Behaviour.RESET}[moving]
    # A device that does not know the LED's instruction has no light to switch off.
    dark = [
        name
        for name in protocol.lights
        if not run.wire(setting(protocol, name, getattr(full, name), full))
    ]
    words = tuple(
        (point.id, point.word_of(seen_now[name]))
        for name, point in points.items()
        if name not in dark
    )
    return Finding(words, "stopped", actual, fault)


def _speed_moving(run: Run, *, first: InstructionSpec) -> Procedure[Finding]:
    full, name = full_state(run.protocol, first), run.protocol.car.speed
    lost = (yield from set_up(run, full)).missing
    yield from _send(run, setting(run.protocol, name, 0, full))
    seen = yield from watch(run, moving=False)
    word, fault = "at-once", lost
    if seen.look.moving:
        yield from _send(run, fitted(run.protocol, first, full.but(**{name: 0})))
        seen = yield from watch(run, moving=False)
        word = "next-motion"
        if seen.look.moving:
            fault = "the speed 0 does not stop it, not even at the next motion"
    word = word if seen.look.moving is not None else ""
    return Finding((("R-speed-moving", word),), "stopped by speed 0", look_words(seen.look), fault)


def _steer_rotating(run: Run, *, turning: InstructionSpec) -> Procedure[Finding]:
    full, car = full_state(run.protocol, turning), run.protocol.car
    lost = (yield from set_up(run, full.but(**{car.steering: 0}))).missing
    yield from _send(run, _steers(run.protocol, turning))
    yield from listen(None, run.timers.silence)
    look = (yield from observe()).look
    words, fault = look_words(look), lost
    opposite = None if look.left is None or look.right is None else look.left * look.right < 0
    if look.moving is False:
        fault = fault or "steering during a rotation stops it"
    word = "remembered"
    motion = car.drive(look).motion
    if opposite is False or (opposite is None and motion not in (None, car.drive(full).motion)):
        word = "curve"
    if opposite is None and motion is None:
        word = ""
    return Finding((("R-steer-rotating", word),), "goes on rotating", words, fault)


def _watchdog(run: Run, *, first: InstructionSpec) -> Procedure[Finding]:
    """Find out whether a driving robot stops, sends or starts again while the line is silent."""
    lost = (yield from set_up_slowly(run, full_state(run.protocol, first))).missing
    begun = yield from watch(run, moving=True)
    point, expected = "R-watchdog", "keeps driving, sends nothing"
    if begun.look.moving is not True:
        fault = lost or ("does not move" if begun.look.moving is False else "")
        return Finding(((point, ""),), expected, look_words(begun.look), fault)
    heard = yield from listen(None, 0)
    seen, came, stopped = begun, heard.answers, 0
    while seen.now - begun.now < (stopped - begun.now + _AGAIN if stopped else run.timers.idle):
        heard = yield from listen(None, _LOOK)
        came += heard.answers
        seen = yield from observe()
        if seen.look.moving is None:
            return Finding(((point, ""),), expected, look_words(seen.look), "", came)
        if not stopped and seen.look.moving is False:
            stopped = seen.now
            run.profile.watchdog = stopped - begun.now
        elif stopped and seen.look.moving:
            return Finding(((point, ""),), expected, look_words(seen.look), "moved again by itself")
    fault = "sends although nothing was asked" if came else ""
    if not stopped and not fault:
        fault = yield from _ignored_fault(run)
    word = "stops" if stopped else "drives-on"
    return Finding(((point, word),), expected, look_words(seen.look), fault, came)


def _ignored_fault(run: Run) -> Procedure[str]:
    """Send a fault to a robot that has driven for long; say so if it does not stop it."""
    if not run.protocol.unused_ids:
        return ""
    yield from _send(run, bytes([run.protocol.header_bytes[run.protocol.unused_ids[0], 0]]))
    seen = yield from watch(run, moving=False)
    seconds = run.timers.idle / 1e9
    deaf = f"after it has driven for {seconds:g} s without a frame, a fault does not stop it"
    return deaf if seen.look.moving else ""


# -- the choices of the first frames, before homing resets the state ------------------------------

_CASE = "the first frames after power-on"


def first_choices(run: Run) -> Procedure[None]:
    """Record what the first fault and the first stop leave of speed, steering and LED.

    Only unambiguous observations count: every answer right, the robot in the state set up before.
    """
    protocol = run.protocol
    mover = next(iter(movers(protocol)), None)
    if mover is None or not run.config.observable:
        return
    full = full_state(protocol, mover)
    fault = protocol.header_bytes.get((protocol.unused_ids[0], 0)) if protocol.unused_ids else None
    stop, unknown = (
        protocol.header_bytes[protocol.stop.id, 0],
        code_of(protocol, Outcome.UNKNOWN_ID),
    )
    if fault is not None and run.config.power and "pipelining" not in run.profile.choices.allowed:
        # Are stops lost that are sent right behind the first fault after power-on?
        yield from send(bytes([fault, stop, stop]))
        heard = yield from run.waiting.all_answers(3)
        if heard.codes == (unknown,):
            run.profile.choices.record("R-pipelining unused-id", "lost-after-fault", _CASE)
            yield from listen(None, run.waiting.idle)
    rows: list[tuple[int, int, Effect | None]] = [
        (stop, code_of(protocol, Outcome.VALID), protocol.stop.effect)
    ]
    if fault is not None:
        rows.insert(0, (fault, unknown, None))
    if not (yield from _drives_on(run, full)):
        return
    for frame, code, effect in rows:
        answered = yield from _sent_in(run, full, bytes([frame]))
        if answered is None or answered.codes != (code,):
            return
        seen = yield from watch(run, moving=False)
        if seen.look.moving and effect is None:
            # A byte changed on the line cannot cause this: a frame without a fault gets another
            # answer. So it counts without a retry.
            case = case_of_the_run(protocol, "power-on/first-fault", bytes([frame]))
            reason = "the first fault after power-on was answered and did not stop it"
            axis = Axis(Verdict.FAIL, "stopped", look_words(seen.look), reason)
            run.conclude(case, {"stop": axis})
        if seen.look.moving is not False:
            return
        _record_choice(run, effect, full, seen.look)
        yield from listen(None, run.timers.settle)


def _drives_on(run: Run, full: State) -> Procedure[bool]:
    """Record what a motion instruction leaves of the steering; false where that is ambiguous."""
    frame = moving_to(run.protocol, full)
    if not frame:
        return False
    heard = yield from _sent_in(run, full, frame)
    if heard is None:
        return False
    seen = yield from watch(run, moving=True)
    if heard.codes != (code_of(run.protocol, Outcome.VALID),) or not seen.look.moving:
        return False
    _record_choice(run, step_of(run.protocol, frame).frame_effect.effect, full, seen.look)
    return True


def _sent_in(run: Run, full: State, frame: bytes) -> Procedure[Received | None]:
    """The answers to a frame that is sent in this state, None where it is not seen."""
    ready = yield from set_up(run, full)
    if ready.missing:
        return None
    seen = yield from watch(run, moving=True)
    if differences(run.model, ready.expected, seen.look):
        return None
    yield from send(frame)
    return (yield from run.waiting.answers(1))


def _record_choice(run: Run, effect: Effect | None, full: State, look: Look) -> None:
    """Record what a frame of this effect, None for a fault, leaves open and does."""
    points = open_after(run.protocol, effect)
    for variable, point in points.items():
        seen, was = getattr(look, variable), getattr(full, variable)
        if seen in (0, was) and was:
            does = Behaviour.KEPT if seen == was else Behaviour.RESET
            run.profile.choices.record(point.id, point.word_of(does), _CASE)


READING = "reading/"
"""What the id of an experiment's case begins with."""


def reading_cases(protocol: Protocol) -> tuple[Case, ...]:
    """The experiments of every run, as cases, without those that only an option adds."""
    return tuple(
        _case(protocol, experiment)
        for experiment in _experiments(protocol)
        if not experiment.option
    )


def _experiments(protocol: Protocol) -> Iterator[Experiment]:
    every = (*answer_experiments(protocol), *state_experiments(protocol))
    # Without points are those on what the grammar has decided, or has no variable for.
    yield from (experiment for experiment in every if experiment.points)


def _case(protocol: Protocol, experiment: Experiment) -> Case:
    reading = POINTS[experiment.points[0]].reading
    clause = protocol.clauses.safety if experiment.safety else protocol.clauses.instructions
    ident = f"{READING}{experiment.name}"
    return runner_case(
        protocol, ident, clause, experiment.requirement, experiment.stimulus, reading
    )


def discover(run: Run) -> Procedure[None]:
    """Make every experiment that device, probe and options allow, and record the choices shown."""
    kept = False
    for experiment in _experiments(run.protocol):
        if experiment.option and experiment.option not in run.profile.choices.allowed:
            continue
        case = _case(run.protocol, experiment)
        if "pipelining" in run.profile.choices.allowed and experiment.points[0] in FLUSH_POINTS:
            continue
        run.begin(case.id)
        if experiment.sees and not run.config.observable:
            axis = run.config.not_observable("one choice of what the document leaves open")
            run.conclude(case, {"state": axis})
        elif experiment.sees and run.profile.moves == set():
            reason = "never seen moving in any kind of motion: is the motor power on?"
            run.conclude(case, {"state": Axis(Verdict.INCONCLUSIVE, "moving", "stopped", reason)})
        else:
            kept = (yield from _settle(run, experiment, case)) or kept
    # One that answers or gives up the data of its own instructions has a time-out.
    run.profile.keeps_waiting = kept and run.profile.choices.differs("R-truncated-known")
    yield from first_frames_lost(run)


def _settle(run: Run, experiment: Experiment, case: Case) -> Procedure[bool]:
    """Make an experiment until two findings agree, and judge its case.

    Returns whether the stops of the homing were taken for the data of a frame that had been cut
    short.
    """
    taken = 0

    def make() -> Procedure[Finding]:
        nonlocal taken
        found = yield from experiment.make(run)
        homed = yield from home(run)
        # A stop is answered OK, unless it was the data that a header had announced.
        ok = run.protocol.answers[Outcome.VALID].code
        taken += experiment.cut and not found.heard and homed.first not in (None, ok)
        return found

    kinds = yield from agree(run, case, make, 1 if experiment.long else AGREE)
    shown = [(max(kind, key=attrgetter("told")), len(kind)) for kind in kinds]
    best = shown[0][0]
    told = [(found, times) for found, times in shown if not found.coarse]
    tries = quantity(sum(times for _, times in told), "try", "tries")
    axis = "state" if experiment.sees else "answer"
    if len(told) > 1 and told[1][1] > 1 and not may_be_noise(run, case, kinds):
        actual = " and ".join(sorted(found.actual for found, _ in told))
        reason = "shows more than one choice; a device keeps to one"
        judged = Axis(Verdict.FAIL, best.expected, actual, reason, case.reading)
        coarse = next((found.coarse for found, _ in shown if found.coarse), "")
        if experiment.timed and not run.config.virtual:
            coarse = coarse or "pauses near the time-out may come out longer at the device"
        run.conclude(case, {axis: judged.uncertain(f"{coarse}: ") if coarse else judged})
        return taken >= AGREE
    judged = _judged(run, best, case)
    # What only a single try has shown does not stay in the profile either.
    choices, profile = run.profile.choices, run.profile
    if "R-watchdog" in experiment.points and not choices.differs("R-watchdog"):
        profile.watchdog = None
    if "R-truncation-timeout" in experiment.points:
        profile.whole_frame = profile.whole_frame and choices.differs("R-truncation-timeout")
    faults = sum(times for found, times in told if found.fault)
    if best.fault and faults <= AGREE:
        judged = run.config.unsteady(judged, faults, tries)
    elif len(told) > 1 and judged.verdict < Verdict.INCONCLUSIVE:
        other, times = told[1]
        reason = other.fault or f"another choice: {other.actual}"
        judged = Axis(Verdict.FAIL, best.expected, best.actual, reason, case.reading)
        judged = run.config.unsteady(judged, times, tries)
    run.conclude(case, {axis: judged}, best.heard)
    return taken >= AGREE


def _judged(run: Run, best: Finding, case: Case) -> Axis:
    """The axis of a finding, with the worst verdict of its choices; records these choices."""
    if best.fault:
        return Axis(Verdict.FAIL, best.expected, best.actual, best.fault, case.reading)
    if best.coarse:
        verdict = Verdict.INFORMATIONAL
        return Axis(verdict, best.expected, best.actual, best.coarse, case.reading)
    worst = Axis(Verdict.PASS, best.expected, best.actual)
    for point, word in best.words:
        if word == "":
            run.profile.choices.hidden.add(point)
            if worst.verdict < Verdict.INCONCLUSIVE:
                reason = f"not observable: the probe does not report ({point})"
                worst = Axis(Verdict.INCONCLUSIVE, best.expected, best.actual, reason)
            continue
        reading = POINTS[point].reading
        verdict, reason = Verdict.FAIL, f"{reading}: {word}"
        if POINTS[point].choice(word) is not None:
            contradicts = run.profile.choices.record(point, word, case.id)
            if not contradicts:
                verdict = verdict_of(point, word)
            reason = contradicts or f"{word}: another reading of {reading}"
        if verdict > worst.verdict:
            worst = Axis(verdict, best.expected, best.actual, reason, reading)
    return worst
