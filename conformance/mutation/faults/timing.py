"""Faults in time: late or repeated answers, late stops, and motion that resumes by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    FOLLOWED,
    SEQUENCE,
    answers_with,
    every,
    faulty,
    is_named,
    is_outcome,
    is_truncated,
    late,
    moving_in,
    resumes_after,
    slug,
    stops_after,
    valid,
    when,
    words,
)
from bilprov.spec.by_effect import moving_motions, setters
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

_FAMILY = "timing"
_STOPS, _RESUMES = 150 * MS, 200 * MS  # times of the faulty watchdog


def timing_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in which an answer or a motion comes late, again or by itself."""
    longest, ok = protocol.timing.answer_longest, protocol.answers[Outcome.VALID].code
    motions = moving_motions(protocol)
    for motion in motions[-1:]:
        yield _fault(
            f"answers-faults-late-while-{words(motion)}",
            f"answers faults much too late while it moves {motion.value}",
            when(every(faulty, moving_in(motion)), late(1.2 * longest)),
            *("responses", "instructions"),
        )
    for milliseconds in (30, 90):
        yield _fault(
            f"answers-again-after-{milliseconds}-ms",
            f"answers a valid instruction again after {milliseconds} ms, "
            "unless another frame comes first",
            when(valid, _again(milliseconds, ok)),
            *("responses", "instructions"),
        )
    yield _fault(
        "answers-fault-again-after-15-ms",
        "answers a fault again after 15 ms, unless another frame comes first",
        when(
            faulty,
            lambda d, e, r: replace(r, unasked=((15 * MS, e.judgement.response.code),)),
        ),
        *("responses", "instructions"),
        caught=(*FOLLOWED, "link/*", "timing/*"),
    )
    stop_longest = protocol.timing.stop_longest
    outcomes = [outcome for outcome in Outcome if outcome is not Outcome.VALID]
    for index, motion in enumerate(motions):
        outcome = outcomes[(index + 1) % len(outcomes)]
        yield _fault(
            f"stops-late-while-{words(motion)}",
            f"a fault stops it much too late while it moves {motion.value}",
            when(every(faulty, moving_in(motion)), stops_after(3 * stop_longest)),
            *("safety", "instructions"),
        )
        yield _fault(
            f"restarts-after-60-ms-from-{words(motion)}",
            f"drives on by itself 60 ms after a fault that stopped it while it moved "
            f"{motion.value}",
            when(every(faulty, moving_in(motion)), resumes_after(60)),
            *("safety", "instructions"),
        )
        yield _fault(
            f"restarts-after-{slug(outcome)}-while-{words(motion)}",
            f"drives on by itself 15 ms after {outcome.value} while it moved {motion.value}",
            when(every(is_outcome(outcome), moving_in(motion)), resumes_after(15)),
            *("safety", "instructions", "responses"),
        )
    yield _fault(
        "restarts-after-200-ms",
        "drives on by itself 200 ms after a fault",
        when(faulty, resumes_after(200)),
        *("safety", "instructions", "responses"),
    )
    yield _fault(
        "restarts-after-a-truncation",
        "drives on by itself 40 ms after a frame that was cut short",
        when(is_truncated, resumes_after(40)),
        *("safety", "responses", "instructions"),
    )
    yield _fault(
        "jerks-after-a-fault",
        "moves for 6 ms by itself, 12 ms after a fault",
        when(
            faulty,
            lambda d, e, r: replace(r, later=((12 * MS, e.before), (18 * MS, r.state))),
        ),
        "safety",
    )
    yield _fault(
        "watchdog-resumes",
        "stops by itself after 150 ms without a frame, and drives on 50 ms later",
        when(valid, _watchdog),
        *("instructions", "safety"),
    )
    stop = protocol.stop
    yield _fault(
        f"{stop.name}-takes-its-time",
        f"{stop.name} stops it much too late",
        when(is_named(stop), stops_after(3 * stop_longest)),
        "instructions",
    )
    yield _fault(
        f"restarts-after-{stop.name}",
        f"drives on by itself 60 ms after {stop.name}",
        when(every(is_named(stop), _moving), resumes_after(60)),
        *("instructions", "safety"),
    )
    for setter in setters(protocol)[-1:]:
        yield _fault(
            f"{setter.name}-takes-its-time",
            f"{setter.name} shows only after 0.3 s, and not at all where a frame comes before",
            when(is_named(setter), stops_after(300)),
            "instructions",
        )
    yield _fault(
        "loses-the-first-answer-when-idle",
        "does not answer the first frame after 120 ms without one",
        when(lambda e: e.gap is not None and e.gap > 120 * MS, answers_with()),
        *("responses", "instructions"),
    )


def _fault(
    name: str, doc: str, react: React, *clauses: str, caught: tuple[str, ...] = SEQUENCE
) -> Fault:
    return Fault(name.lower(), _FAMILY, doc, caught, react=react, clauses=clauses)


def _again(milliseconds: int, code: int) -> React:
    return lambda device, event, reaction: replace(reaction, unasked=((milliseconds * MS, code),))


def _moving(event: Event) -> bool:
    return event.before.moving


def _watchdog(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not reaction.state.moving:
        return reaction
    stopped = replace(reaction.state, motion=Motion.STOPPED)
    return replace(reaction, later=((_STOPS, stopped), (_RESUMES, reaction.state)))
