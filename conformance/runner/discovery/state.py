"""Experiments on the robot's state after a frame, where the document is silent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.cases.steps import unused_id_frame, wrong_length_frame
from bilprov.conformance.dut.operations import Procedure, listen, observe, send
from bilprov.conformance.oracle.state_model import rotates
from bilprov.conformance.oracle.wording import look_words
from bilprov.conformance.runner.discovery.experiment import Experiment, Finding
from bilprov.conformance.runner.homing import set_up, watch
from bilprov.conformance.runner.run import Run
from bilprov.spec.by_effect import moves, setting
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol

_LOOK = 50 * MS  # between two looks while the line is silent
_AGAIN = 500 * MS  # how long a robot that stopped by itself is observed


def state_experiments(protocol: Protocol) -> Iterator[Experiment]:
    """Every experiment that needs looks."""
    movers = [s for s in protocol.instructions if moves(s) and not s.length]
    straight = [s for s in movers if not rotates(_moving(protocol, s))]
    turning = [s for s in movers if rotates(_moving(protocol, s))]
    if not straight:
        return
    first, last = straight[0], straight[-1]
    limits = protocol.limits
    if "steering" in limits:
        yield _probe(
            "drive-steering",
            ("R-drive-steering",),
            f"{last.name} keeps the steering",
            partial(_drive_steering, first=first, last=last),
            protocol.header_bytes[last.id, 0],
        )
    stop = bytes([protocol.header_bytes[protocol.stop.id, 0]])
    points = ("R-stop-steering", "R-stop-speed", "R-led-state stop")
    yield _probe(
        "after-stop",
        _known(protocol, points),
        f"{protocol.stop.name} resets the directions and keeps speed and LED",
        partial(_after, first=first, frame=stop, points=points),
        stop[0],
    )
    fill = bytes([protocol.pad_byte])
    fault = (
        unused_id_frame(protocol, protocol.unused_ids[0], 0, b"")
        if protocol.unused_ids
        else wrong_length_frame(protocol, protocol.stop, 1, fill)
    ).frame
    points = ("R-fault-state steering", "R-fault-state speed", "R-led-state fault")
    yield _probe(
        "after-fault",
        _known(protocol, points),
        "a fault resets what a stop does and keeps speed and LED",
        partial(_after, first=first, frame=fault, points=points),
        fault[0],
    )
    if setting(protocol, "speed", 0):
        yield _probe(
            "speed-moving",
            ("R-speed-moving",),
            "a speed takes effect at once",
            partial(_speed_moving, first=first),
            setting(protocol, "speed", 0)[0],
        )
    if turning and "steering" in limits:
        yield _probe(
            "steer-rotating",
            ("R-steer-rotating",),
            "steering during a rotation does not end it",
            partial(_steer_rotating, turning=turning[0]),
            protocol.header_bytes[turning[0].id, 0],
        )
    yield Experiment(
        "watchdog",
        ("R-watchdog",),
        "keeps driving while the line is silent, and sends nothing by itself",
        partial(_watchdog, first=first),
        bytes([protocol.header_bytes[first.id, 0]]),
        sees=True,
        safety=True,
        long=True,
    )


def _probe(
    name: str,
    points: tuple[str, ...],
    requirement: str,
    make: Callable[[Run], Procedure[Finding]],
    header: int,
) -> Experiment:
    return Experiment(name, points, requirement, make, bytes([header]), sees=True, safety=True)


def _known(protocol: Protocol, points: tuple[str, ...]) -> tuple[str, ...]:
    """The points about variables that the protocol sets."""
    names = {"steering": "steering", "speed": "speed", "led": "led"}
    return tuple(p for p in points if any(n in p and names[n] in protocol.limits for n in names))


def _moving(protocol: Protocol, spec: InstructionSpec) -> State:
    return spec.effect.apply(protocol.power_on)


def _full(protocol: Protocol, motion: Motion) -> State:
    """A state in which every variable is far from its value at rest."""
    ends = {name: high for name, (_, high) in protocol.limits.items()}
    return State(motion, ends.get("speed", 0), ends.get("steering", 0), ends.get("led", 0))


def _motion(spec: InstructionSpec) -> Motion:
    assert spec.effect.motion is not None
    return spec.effect.motion


def _send(run: Run, frame: bytes) -> Procedure[int]:
    """Send a frame and wait for its answer; returns how many answers came."""
    yield from send(frame)
    heard = yield from run.waiting.answers(1)
    return len(heard.answers)


def _steering(look: Look, full: State) -> str:
    """The choice that a moving robot's steering shows: kept, reset, "" if it cannot be told."""
    if look.steering is not None:
        known = {full.steering: "kept", 0: "reset"}
        return known.get(look.steering, f"steering is {look.steering}")
    if look.left is None or look.right is None or not look.moving:
        return ""
    return "reset" if look.left == look.right else "kept"


def _drive_steering(
    run: Run, *, first: InstructionSpec, last: InstructionSpec
) -> Procedure[Finding]:
    full = _full(run.protocol, _motion(first))
    lost = (yield from set_up(run, full)).missing
    yield from _send(run, bytes([run.protocol.header_bytes[last.id, 0]]))
    seen = yield from watch(run, moving=True, patience=run.timers.deadline)
    word = _steering(seen.look, full)
    word = "straight" if word == "reset" else word
    return Finding((("R-drive-steering", word),), "steering kept", look_words(seen.look), lost)


def _after(
    run: Run, *, first: InstructionSpec, frame: bytes, points: tuple[str, ...]
) -> Procedure[Finding]:
    """Find out what a frame that stops the robot leaves of steering, speed and LED."""
    protocol = run.protocol
    full = _full(protocol, _motion(first))
    lost = (yield from set_up(run, full)).missing
    yield from watch(run, moving=True, patience=run.timers.deadline)
    yield from _send(run, frame)
    seen = yield from watch(run, moving=False, patience=run.timers.deadline)
    look, actual = seen.look, look_words(seen.look)
    fault = lost or ("still moves" if look.moving else "")
    yield from listen(None, run.waiting.timeout if run.profile.flushes else 0)
    again = look
    if look.speed is None or look.steering is None:
        # What the probe does not tell shows when the robot drives again.
        yield from _send(run, bytes([protocol.header_bytes[first.id, 0]]))
        again = (yield from watch(run, moving=True, patience=run.timers.deadline)).look
        actual += f"; driving again: {look_words(again)}"
    speed_again = again
    if again.moving is False and look.steering is None and full.speed:
        # Its speed was zeroed; with a new one its steering shows.
        yield from _send(run, setting(protocol, "speed", full.speed))
        yield from _send(run, bytes([protocol.header_bytes[first.id, 0]]))
        again = (yield from watch(run, moving=True, patience=run.timers.deadline)).look
    straight = run.profile.choices.differs("R-drive-steering")
    blind = look.steering is None and straight
    steering = "" if blind else _steering(look if look.steering is not None else again, full)
    if look.speed is not None:
        speed = {full.speed: "kept", 0: "zeroed"}.get(look.speed, f"speed is {look.speed}")
    else:
        moves_on = speed_again.moving
        speed = "" if moves_on is None else "kept" if moves_on else "zeroed"
    leds = {None: "", full.led: "unchanged", 0: "off"}
    led = leds.get(look.led, f"LED is {look.led}")
    words = dict(zip(points, (steering, speed, led), strict=True))
    known = _known(protocol, points)
    if not run.wire(setting(protocol, "led", full.led)):
        # A device that does not know the LED's instruction has no light to switch off.
        known = tuple(p for p in known if "led" not in p)
    return Finding(tuple((p, words[p]) for p in known), "stopped", actual, fault)


def _speed_moving(run: Run, *, first: InstructionSpec) -> Procedure[Finding]:
    full = _full(run.protocol, _motion(first))
    lost = (yield from set_up(run, full)).missing
    yield from _send(run, setting(run.protocol, "speed", 0))
    seen = yield from watch(run, moving=False, patience=run.timers.deadline)
    word, fault = "at-once", lost
    if seen.look.moving:
        yield from _send(run, bytes([run.protocol.header_bytes[first.id, 0]]))
        seen = yield from watch(run, moving=False, patience=run.timers.deadline)
        word = "next-motion"
        if seen.look.moving:
            fault = "the speed 0 does not stop it, not even at the next motion"
    word = word if seen.look.moving is not None else ""
    return Finding((("R-speed-moving", word),), "stopped by speed 0", look_words(seen.look), fault)


def _steer_rotating(run: Run, *, turning: InstructionSpec) -> Procedure[Finding]:
    full = _full(run.protocol, _motion(turning))
    lost = (yield from set_up(run, State(full.motion, full.speed, 0, full.led))).missing
    yield from _send(run, setting(run.protocol, "steering", full.steering))
    yield from listen(None, run.timers.silence)
    look = (yield from observe()).look
    words, fault = look_words(look), lost
    opposite = None if look.left is None or look.right is None else look.left * look.right < 0
    if look.moving is False:
        fault = fault or "steering during a rotation stops it"
    word = "remembered"
    if opposite is False or (opposite is None and look.motion not in (None, full.motion.value)):
        word = "curve"
    if opposite is None and look.motion is None:
        word = ""
    return Finding((("R-steer-rotating", word),), "goes on rotating", words, fault)


def _watchdog(run: Run, *, first: InstructionSpec) -> Procedure[Finding]:
    """Find out whether a driving robot stops, sends or starts again while the line is silent."""
    lost = (yield from set_up(run, _full(run.protocol, _motion(first)))).missing
    begun = yield from watch(run, moving=True, patience=run.timers.deadline)
    point, expected = "R-watchdog", "keeps driving, says nothing"
    if begun.look.moving is not True:
        fault = lost or "does not move"
        return Finding(((point, ""),), expected, look_words(begun.look), fault)
    heard = yield from listen(None, 0)
    seen, came, stopped = begun, heard.answers, 0
    while seen.now - begun.now < (stopped - begun.now + _AGAIN if stopped else run.timers.idle):
        heard = yield from listen(None, _LOOK)
        came += heard.answers
        seen = yield from observe()
        if not stopped and seen.look.moving is False:
            stopped = seen.now
            run.profile.watchdog = stopped - begun.now
        elif stopped and seen.look.moving:
            return Finding(((point, ""),), expected, look_words(seen.look), "moved again by itself")
    fault = "sends although nothing was asked" if came else ""
    word = "stops" if stopped else "drives-on"
    return Finding(((point, word),), expected, look_words(seen.look), fault, came)
