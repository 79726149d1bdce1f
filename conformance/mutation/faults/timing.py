"""Faults in time: late or repeated answers, late stops, and motion that resumes by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, Reaction
from bilprov.conformance.mutation.faults.family import FOLLOWED, Family, slug, words
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    answers_again,
    every,
    faulty,
    is_named,
    is_outcome,
    is_truncated,
    late,
    moving,
    moving_in,
    resumes_after,
    silent,
    stops_after,
    valid,
    when,
)
from bilprov.spec.by_effect import moving_motions, setters
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

answer_time_fault = Family("timing", "responses instructions")
stop_time_fault = Family("timing", "safety instructions")
motion_time_fault = Family("timing", "instructions")

_STOPS, _RESUMES = 150 * MS, 200 * MS  # times of the faulty watchdog


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
        when(valid, _watchdog),
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


def _watchdog(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not reaction.state.moving:
        return reaction
    stopped = replace(reaction.state, motion=Motion.STOPPED)
    return replace(reaction, later=((_STOPS, stopped), (_RESUMES, reaction.state)))
