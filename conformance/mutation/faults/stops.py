"""Faults in the safety stop: missing, temporary, missing in one motion, too late, partial."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    CUT,
    FOLLOWED,
    TIMED,
    WATCHED,
    WATCHED_FAULTS,
    drives_on,
    faults_only,
    is_outcome,
    is_truncated,
    slug,
    when,
)
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol


def stop_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the safety stop."""
    family = "stop"
    for outcome in Outcome:
        if outcome is Outcome.VALID:
            continue
        yield Fault(
            f"no-stop-on-{slug(outcome)}",
            family,
            f"drives on after {outcome.value}",
            WATCHED[outcome],
            react=when(is_outcome(outcome), drives_on),
        )
    yield Fault(
        "no-stop-on-truncated",
        family,
        "drives on after a frame that is cut short, and answers it",
        CUT,
        react=when(is_truncated, drives_on),
    )
    for motion in moving_motions(protocol):
        yield Fault(
            f"no-stop-while-{motion.value.replace('_', '-')}",
            family,
            f"a fault does not stop it while it moves {motion.value}",
            (*WATCHED_FAULTS, *(TIMED if motion is min(moving_motions(protocol)) else ())),
            react=faults_only(
                lambda d, e, r, motion=motion: (  # type: ignore[misc]
                    replace(r, state=e.before) if e.before.motion is motion else r
                )
            ),
        )
    late = int(protocol.timing.stop_longest * MS)
    yield Fault(
        "stops-late",
        family,
        "stops three times later than the longest time that is allowed",
        (*WATCHED_FAULTS, *TIMED),
        react=faults_only(lambda d, e, r: replace(r, state=e.before, later=((3 * late, r.state),))),
    )
    yield Fault(
        "restarts-by-itself",
        family,
        "stops at a fault and drives on 120 ms later",
        FOLLOWED,
        react=faults_only(lambda d, e, r: replace(r, later=((120 * MS, e.before),))),
    )
    yield Fault(
        "restarts-on-next-valid",
        family,
        "after a fault any valid instruction makes it drive on as before",
        FOLLOWED,
        react=_restart_on_next,
    )
    yield Fault(
        "stop-keeps-one-wheel",
        family,
        "a fault stops the left wheel only",
        (*WATCHED_FAULTS, *TIMED),
        react=_left_wheel_only,
    )
    yield Fault(
        "stays-dead-after-fault",
        family,
        "after a fault it answers but never moves again until a Stop",
        WATCHED_FAULTS,
        react=_dead_after_fault,
    )


def _restart_on_next(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not event.judgement.valid:
        if event.before.moving:
            device.memory["motion"] = list(Motion).index(event.before.motion)
        return reaction
    motion = device.memory.pop("motion", None)
    instruction = event.judgement.instruction
    if motion is None or (instruction and instruction.effect.sets("motion")):
        return reaction
    return replace(reaction, state=replace(reaction.state, motion=list(Motion)[motion]))


def _left_wheel_only(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    """Effect: at a fault only the left wheel stops, which a probe sees as a rotation."""
    turning = event.before.moving and not event.judgement.valid
    if not turning:
        return reaction
    return replace(reaction, state=replace(event.before, motion=Motion.ROTATE_LEFT))


def _dead_after_fault(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    if not event.judgement.valid:
        device.memory["dead"] = 1
    elif event.judgement.id == device.protocol.stop.id:
        device.memory.pop("dead", None)
    if "dead" in device.memory:
        return replace(reaction, state=replace(reaction.state, motion=Motion.STOPPED))
    return reaction
