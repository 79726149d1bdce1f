"""Faults in the motion: missing, swapped, or not asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    FOLLOWED,
    WATCHED_FAULTS,
    drives_on,
    is_named,
    stands_still,
    starts_driving,
    when,
)
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import InstructionSpec, Protocol


def motion_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in the motion."""
    family = "motion"
    yield Fault(
        "never-moves",
        family,
        "answers rightly and never moves: its motor power is off",
        exit=3,
        react=stands_still,
    )
    movers = [s for s in protocol.instructions if s.effect.motion in moving_motions(protocol)]
    for spec in movers:
        yield Fault(
            f"{spec.name.lower()}-does-nothing",
            family,
            f"answers {spec.name} and does not move",
            ("valid/*",),
            react=when(
                is_named(spec),
                stands_still,
            ),
        )
    for one, other in zip(movers[::2], movers[1::2], strict=False):
        yield Fault(
            f"{one.name.lower()}-{other.name.lower()}-swapped",
            family,
            f"takes {one.name} for {other.name} and the other way round",
            ("valid/*", *WATCHED_FAULTS),
            react=_swapped_motions(one, other),
        )
    steers = [s for s in protocol.instructions if s.effect.sets("steering") and s.fields]
    if steers:
        yield Fault(
            "steering-swapped",
            family,
            f"takes {' for '.join(s.name for s in steers)} and the other way round",
            ("valid/*",),
            react=when(
                lambda e: any(is_named(s)(e) for s in steers),
                lambda d, e, r: replace(r, state=replace(r.state, steering=-r.state.steering)),
            ),
        )
        yield Fault(
            "steering-starts-it",
            family,
            "steering while stopped makes it drive",
            (f"valid/{protocol.stop.name}", *FOLLOWED),
            react=when(lambda e: any(is_named(s)(e) for s in steers), starts_driving),
        )
    yield Fault(
        "stop-does-nothing",
        family,
        f"answers {protocol.stop.name} and drives on",
        (f"valid/{protocol.stop.name}", "leave/stopped"),
        react=when(is_named(protocol.stop), drives_on),
    )
    yield Fault(
        "moves-at-power-on",
        family,
        "drives as soon as it is switched on",
        ("power-on/*",),
        power_on=State(motion=Motion.FORWARD, speed=protocol.limits.get("speed", (0, 1))[1]),
    )


def _swapped_motions(one: InstructionSpec, other: InstructionSpec) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        for spec, taken in ((one, other), (other, one)):
            if is_named(spec)(event):
                return replace(reaction, state=taken.effect.apply(event.before))
        return reaction

    return react
