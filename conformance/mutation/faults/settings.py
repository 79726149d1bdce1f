"""Faults in the state variables that a device remembers: speed and LED."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    FOLLOWED,
    WATCHED_FAULTS,
    drives_on,
    faults_only,
    is_named,
    is_outcome,
    stands_still,
    starts_driving,
    when,
)
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol


def setting_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults in remembered speed and LED."""
    family = "setting"
    setters = {
        variable: [
            s
            for s in protocol.instructions
            if s.effect.sets(variable) and s.fields and not s.effect.sets("motion")
        ]
        for variable in ("speed", "led")
    }
    for spec in setters["speed"]:
        named = is_named(spec)
        yield Fault(
            f"{spec.name.lower()}-starts-it",
            family,
            f"{spec.name} makes a stopped robot drive",
            ("power-on/*", f"valid/{protocol.stop.name}", *FOLLOWED),
            react=when(named, starts_driving),
        )
        yield Fault(
            f"{spec.name.lower()}-ignored-at-full",
            family,
            f"{spec.name} at its highest value is answered and ignored",
            ("valid/*", *FOLLOWED),
            react=when(
                lambda e, s=spec: (
                    is_named(s)(e)  # type: ignore[misc]
                    and any(
                        v == f.high for f, (_, v) in zip(s.fields, e.judgement.fields, strict=True)
                    )
                ),
                drives_on,
            ),
        )
        yield Fault(
            f"{spec.name.lower()}-stops-it",
            family,
            f"{spec.name} stops a moving robot",
            ("valid/*",),
            react=when(named, stands_still),
        )
    for spec in setters["led"]:
        named, part = is_named(spec), spec.fields[0]
        yield Fault(
            f"{spec.name.lower()}-order-reversed",
            family,
            f"{spec.name} takes the colours in the wrong order",
            ("valid/*", *WATCHED_FAULTS),
            react=when(named, _reversed_bits(len(part.bits))),
        )
        for index, bit in enumerate(reversed(part.bits)):
            yield Fault(
                f"{spec.name.lower()}-{bit.lower()}-stuck-off",
                family,
                f"{spec.name} never switches {bit} on",
                ("valid/*", *WATCHED_FAULTS),
                react=when(
                    named,
                    lambda d, e, r, mask=~(1 << index): replace(  # type: ignore[misc]
                        r, state=replace(r.state, led=r.state.led & mask)
                    ),
                ),
            )
        yield Fault(
            f"{spec.name.lower()}-restarts-it",
            family,
            f"{spec.name} makes a stopped robot drive",
            (f"valid/{protocol.stop.name}", *FOLLOWED),
            react=when(named, starts_driving),
        )
    if setters["led"]:
        high = protocol.limits["led"][1]
        yield Fault(
            "bad-data-shown",
            family,
            "refuses bad data and stops, but shows their low bits",
            ("bad-data/*", "recovery/bad-data/*"),
            react=when(
                is_outcome(Outcome.BAD_DATA),
                lambda d, e, r: replace(
                    r, state=replace(r.state, led=e.judgement.fields[0][1] & high)
                ),
            ),
        )
    if setters["speed"]:
        yield Fault(
            "fault-changes-speed",
            family,
            "a fault halves the speed that was set",
            WATCHED_FAULTS,
            react=faults_only(
                lambda d, e, r: replace(r, state=replace(r.state, speed=r.state.speed // 2))
            ),
        )
    if setters["led"]:
        yield Fault(
            "fault-changes-led",
            family,
            "a fault inverts the LED",
            WATCHED_FAULTS,
            react=faults_only(
                lambda d, e, r: replace(
                    r,
                    state=replace(r.state, led=protocol.limits["led"][1] - r.state.led),
                )
            ),
        )


def _reversed_bits(width: int) -> React:
    def react(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
        turned = int(f"{reaction.state.led:0{width}b}"[::-1], 2)
        return replace(reaction, state=replace(reaction.state, led=turned))

    return react
