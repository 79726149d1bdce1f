"""Faults in the robot's state: the safety stop, the motion, and the speed and LED that are set.

Those in time too: late or repeated answers, late stops, and motion that resumes by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Fault, React
from bilprov.conformance.mutation.faults.family import (
    CUT,
    FOLLOWED,
    POWER_ON,
    TIMED,
    WATCHED,
    WATCHED_FAULTS,
    Family,
    slug,
    words,
)
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    Condition,
    answers_again,
    becomes,
    clears_bit,
    drives_on,
    every,
    faulty,
    is_named,
    is_outcome,
    is_truncated,
    latched,
    late,
    moving,
    moving_in,
    resizes,
    restarts,
    resumes_after,
    sets,
    shows_low_bits,
    silent,
    stands_still,
    starts_driving,
    stops_after,
    then,
    valid,
    watchdog,
    when,
)
from bilprov.spec.by_effect import moving_motions, setters
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol

stop_fault = Family("stop", "safety instructions responses", WATCHED_FAULTS)
motion_fault = Family("motion", "instructions safety", ("valid/*",))
setting_fault = Family("setting", "instructions safety", ("valid/*", *WATCHED_FAULTS))
answer_time_fault = Family("timing", "responses instructions")
stop_time_fault = Family("timing", "safety instructions")
motion_time_fault = Family("timing", "instructions")


def stop_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the safety stop: missing, temporary, too late, partial."""
    for outcome in FAULTY:
        yield stop_fault(
            f"no-stop-on-{slug(outcome)}",
            f"drives on after {outcome.value}",
            when(is_outcome(outcome), drives_on),
            caught_by=WATCHED[outcome],
        )
    yield stop_fault(
        "no-stop-on-truncated",
        "drives on after a frame that is cut short, and answers it",
        when(is_truncated, drives_on),
        caught_by=CUT,
    )
    motions = moving_motions(protocol)
    for motion in motions:
        yield stop_fault(
            f"no-stop-while-{words(motion)}",
            f"a fault does not stop it while it moves {motion.value}",
            when(every(faulty, _set_to(motion)), drives_on),
            caught_by=(*WATCHED_FAULTS, *TIMED) if motion is min(motions) else WATCHED_FAULTS,
        )
    yield stop_fault(
        "stops-late",
        "stops three times later than the longest time that is allowed",
        when(faulty, stops_after(3 * protocol.timing.stop_longest)),
        caught_by=(*WATCHED_FAULTS, *TIMED),
    )
    yield stop_fault(
        "restarts-by-itself",
        "stops at a fault and drives on 120 ms later",
        when(faulty, resumes_after(120)),
        caught_by=FOLLOWED,
    )
    yield stop_fault(
        "restarts-on-next-valid",
        "after a fault any valid instruction makes it drive on as before",
        restarts(valid),
        caught_by=FOLLOWED,
    )
    yield stop_fault(
        "stop-keeps-one-wheel",
        "a fault stops the left wheel only",
        # A probe sees a robot with one wheel stopped as rotating.
        when(every(moving, faulty), then(drives_on, sets(motion=Motion.ROTATE_LEFT))),
        caught_by=(*WATCHED_FAULTS, *TIMED),
    )
    yield stop_fault(
        "stays-dead-after-fault",
        "after a fault it answers but never moves again until a Stop",
        latched(faulty, stands_still, ends=is_named(protocol.stop)),
    )


def motion_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the motion: missing, swapped, or not asked for."""
    stop = protocol.stop
    yield motion_fault(
        "never-moves",
        "answers rightly and never moves: its motor power is off",
        stands_still,
        caught_by=(),
        exit=3,
    )
    movers = [s for s in protocol.instructions if s.effect.motion in moving_motions(protocol)]
    for spec in movers:
        yield motion_fault(
            f"{spec.name}-does-nothing",
            f"answers {spec.name} and does not move",
            when(is_named(spec), stands_still),
        )
    for one, other in zip(movers[::2], movers[1::2], strict=False):
        yield motion_fault(
            f"{one.name}-{other.name}-swapped",
            f"takes {one.name} for {other.name} and the other way round",
            then(when(is_named(one), _does(other)), when(is_named(other), _does(one))),
            caught_by=("valid/*", *WATCHED_FAULTS),
        )
    steers = [s for s in protocol.instructions if s.effect.sets("steering") and s.fields]
    if steers:
        yield motion_fault(
            "steering-swapped",
            f"takes {' for '.join(s.name for s in steers)} and the other way round",
            when(is_named(*steers), becomes(lambda e, s: replace(s, steering=-s.steering))),
        )
        yield motion_fault(
            "steering-starts-it",
            "steering while stopped makes it drive",
            when(is_named(*steers), starts_driving),
            caught_by=(f"valid/{stop.name}", *FOLLOWED),
        )
    yield motion_fault(
        "stop-does-nothing",
        f"answers {stop.name} and drives on",
        when(is_named(stop), drives_on),
        caught_by=(f"valid/{stop.name}", "leave/stopped"),
    )
    yield motion_fault(
        "moves-at-power-on",
        "drives as soon as it is switched on",
        caught_by=POWER_ON,
        power_on=State(motion=Motion.FORWARD, speed=protocol.limits.get("speed", (0, 1))[1]),
    )


def setting_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the speed and the LED that a device remembers."""
    at_rest = f"valid/{protocol.stop.name}"
    speeds, lights = (
        [s for s in setters(protocol) if s.effect.sets(variable)] for variable in ("speed", "led")
    )
    for spec in speeds:
        yield setting_fault(
            f"{spec.name}-starts-it",
            f"{spec.name} makes a stopped robot drive",
            when(is_named(spec), starts_driving),
            caught_by=(*POWER_ON, at_rest, *FOLLOWED),
        )
        yield setting_fault(
            f"{spec.name}-ignored-at-full",
            f"{spec.name} at its highest value is answered and ignored",
            when(every(is_named(spec), _at_full(spec)), drives_on),
            caught_by=("valid/*", *FOLLOWED),
        )
        yield setting_fault(
            f"{spec.name}-stops-it",
            f"{spec.name} stops a moving robot",
            when(is_named(spec), stands_still),
            caught_by=("valid/*",),
        )
    for spec in lights:
        bits = spec.fields[0].bits
        yield setting_fault(
            f"{spec.name}-order-reversed",
            f"{spec.name} takes the colours in the wrong order",
            when(is_named(spec), _reverses_bits(len(bits))),
        )
        for index, bit in enumerate(reversed(bits)):
            yield setting_fault(
                f"{spec.name}-{bit}-stuck-off",
                f"{spec.name} never switches {bit} on",
                when(is_named(spec), clears_bit("led", index)),
            )
        yield setting_fault(
            f"{spec.name}-restarts-it",
            f"{spec.name} makes a stopped robot drive",
            when(is_named(spec), starts_driving),
            caught_by=(at_rest, *FOLLOWED),
        )
    high = protocol.limits.get("led", (0, 0))[1]
    if lights:
        yield setting_fault(
            "bad-data-shown",
            "refuses bad data and stops, but shows their low bits",
            when(is_outcome(Outcome.BAD_DATA), shows_low_bits(high)),
            caught_by=WATCHED[Outcome.BAD_DATA],
        )
    if speeds:
        yield setting_fault(
            "fault-changes-speed",
            "a fault halves the speed that was set",
            when(faulty, resizes("speed", lambda speed: speed // 2)),
            caught_by=WATCHED_FAULTS,
        )
    if lights:
        yield setting_fault(
            "fault-changes-led",
            "a fault inverts the LED",
            when(faulty, resizes("led", lambda led: high - led)),
            caught_by=WATCHED_FAULTS,
        )


def timing_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in which an answer or a motion comes late, again or by itself."""
    much_too_late = 3 * protocol.timing.stop_longest
    motions = moving_motions(protocol)
    for motion in motions[-1:]:
        yield answer_time_fault(
            f"answers-faults-late-while-{words(motion)}",
            f"answers faults much too late while it moves {motion.value}",
            when(every(faulty, moving_in(motion)), late(1.2 * protocol.timing.answer_longest)),
        )
    for pause in (30, 90):
        yield answer_time_fault(
            f"answers-again-after-{pause}-ms",
            f"answers a valid instruction again after {pause} ms, unless another frame comes first",
            when(valid, answers_again(pause)),
        )
    yield answer_time_fault(
        "answers-fault-again-after-15-ms",
        "answers a fault again after 15 ms, unless another frame comes first",
        when(faulty, answers_again(15)),
        caught_by=(*FOLLOWED, "link/*", "timing/*"),
    )
    for index, motion in enumerate(motions):
        outcome = FAULTY[(index + 1) % len(FAULTY)]
        yield stop_time_fault(
            f"stops-late-while-{words(motion)}",
            f"a fault stops it much too late while it moves {motion.value}",
            when(every(faulty, moving_in(motion)), stops_after(much_too_late)),
        )
        yield stop_time_fault(
            f"restarts-after-60-ms-from-{words(motion)}",
            f"drives on by itself 60 ms after a fault that stopped it while it moved "
            f"{motion.value}",
            when(every(faulty, moving_in(motion)), resumes_after(60)),
        )
        yield stop_time_fault(
            f"restarts-after-{slug(outcome)}-while-{words(motion)}",
            f"drives on by itself 15 ms after {outcome.value} while it moved {motion.value}",
            when(every(is_outcome(outcome), moving_in(motion)), resumes_after(15)),
            clauses="safety instructions responses",
        )
    yield stop_time_fault(
        "restarts-after-200-ms",
        "drives on by itself 200 ms after a fault",
        when(faulty, resumes_after(200)),
        clauses="safety instructions responses",
    )
    yield stop_time_fault(
        "restarts-after-a-truncation",
        "drives on by itself 40 ms after a frame that was cut short",
        when(is_truncated, resumes_after(40)),
        clauses="safety responses instructions",
    )
    yield stop_time_fault(
        "jerks-after-a-fault",
        "moves for 6 ms by itself, 12 ms after a fault",
        when(
            faulty,
            lambda d, e, r: replace(r, later=((12 * MS, e.before), (18 * MS, r.state))),
        ),
        clauses="safety",
    )
    stop = protocol.stop
    yield motion_time_fault(
        "watchdog-resumes",
        "stops by itself after 150 ms without a frame, and drives on 50 ms later",
        when(valid, watchdog(150, resumes=200)),
        clauses="instructions safety",
    )
    yield motion_time_fault(
        f"{stop.name}-takes-its-time",
        f"{stop.name} stops it much too late",
        when(is_named(stop), stops_after(much_too_late)),
    )
    yield motion_time_fault(
        f"restarts-after-{stop.name}",
        f"drives on by itself 60 ms after {stop.name}",
        when(every(is_named(stop), moving), resumes_after(60)),
        clauses="instructions safety",
    )
    for setter in setters(protocol)[-1:]:
        yield motion_time_fault(
            f"{setter.name}-takes-its-time",
            f"{setter.name} shows only after 0.3 s, and not at all where a frame comes before",
            when(is_named(setter), stops_after(300)),
        )
    yield answer_time_fault(
        "loses-the-first-answer-when-idle",
        "does not answer the first frame after 120 ms without one",
        when(lambda e: e.gap is not None and e.gap > 120 * MS, silent),
    )


def _set_to(motion: Motion) -> Condition:
    """Return a trigger: that motion was set when the frame came, at any speed."""
    return lambda event: event.before.motion is motion


def _does(spec: InstructionSpec) -> React:
    """Return an effect: what this instruction does is done."""
    return becomes(lambda event, state: spec.effect.apply(event.before))


def _at_full(spec: InstructionSpec) -> Condition:
    """Return a trigger, for frames of this instruction: a field has its highest value."""
    return lambda event: any(
        value == part.high
        for part, (_, value) in zip(spec.fields, event.judgement.fields, strict=True)
    )


def _reverses_bits(width: int) -> React:
    """Return an effect: the LED's bits are in the wrong order."""
    return resizes("led", lambda led: int(f"{led:0{width}b}"[::-1], 2))
