"""Generates the single-frame cases from the Protocol, with what a conforming device must do.

A case is a value and states its own expectation from the rule that it tests; it never calls
`spec.codec.judge`. (A test checks that the two agree.)
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.steps import (
    FrameClass,
    Step,
    bad_data_frames,
    truncated_frame,
    unused_id_frame,
    valid_frames,
    wrong_length_frame,
)
from bilprov.conformance.cases.wheel_sweeps import evenly
from bilprov.spec.by_effect import after, fitted, movers, moving_motions, reached
from bilprov.spec.codec import spaced
from bilprov.spec.motion import Motion, State, rotates
from bilprov.spec.protocol import Protocol

_VALUES = 1024  # of a variable that are used; those of a wide field are evenly spaced


class _Setups:
    """Start states, drawn so that data and motions rotate through all of their values."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        draw = random.Random(seed)
        self._motions = _blocks(draw, _motions(protocol))
        limits = protocol.limits
        fast = limits.get("speed", (0, 0))[1]
        # At least half speed: a wheel must be seen to turn, also the inner one of a curve.
        self._speeds, self._steers, self._leds = (
            cycle(draw.sample(values := evenly(low, high, _VALUES), len(values)))
            for low, high in (
                (min(fast, max(1, fast // 2)), fast),
                limits.get("steering", (0, 0)),
                limits.get("led", (0, 0)),
            )
        )
        self._protocol = protocol
        self._power_on = protocol.power_on

    def next(self, motion: Motion | None = None) -> State:
        motion = motion or next(self._motions)
        # Steering in a rotation may become a curve (R-steer-rotating): a case tests it, no set-up.
        steers = not rotates(motion)
        state = replace(
            self._power_on,
            motion=motion,
            speed=next(self._speeds),
            steering=next(self._steers) if steers else self._power_on.steering,
            led=next(self._leds),
        )
        return reached(self._protocol, state)


def _motions(protocol: Protocol) -> tuple[Motion, ...]:
    """The motions in which frames are tried: those that move, if there are any."""
    return moving_motions(protocol) or (Motion.STOPPED,)


def _blocks(draw: random.Random, motions: tuple[Motion, ...]) -> Iterator[Motion]:
    """Motions without end, each as often as the others, in no fixed relation to what is sent."""
    while True:
        yield from draw.sample(motions, len(motions))


def all_cases(protocol: Protocol, seed: int, *, every_cut: bool) -> tuple[Case, ...]:
    """Every single-frame case and the recovery from each class.

    With `every_cut` each header is truncated at every place. Without it, because each truncation
    costs a time-out, only valid headers are, and of the others one of each ID, at a place that
    rotates: the combinations hold more of them.
    """
    setups = _Setups(protocol, seed)
    found = [
        *_valid(protocol, setups),
        *_unused_ids(protocol, setups),
        *_wrong_lengths(protocol, setups),
        *_bad_data(protocol, setups),
        *_truncated(protocol, setups, every_cut=every_cut),
        *_recovery(protocol, setups),
    ]
    return tuple(_mark_thorough(found))


def _mark_thorough(found: list[Case]) -> Iterator[Case]:
    """The cases, the first of each class of fault in each kind of motion marked as thorough."""
    seen: set[tuple[FrameClass, int, Motion]] = set()
    for case in found:
        answer = case.accepted[0].codes[0] if case.kind is FrameClass.WRONG_LENGTH else -1
        key = (case.kind, answer, case.setup.motion)
        first = case.kind not in (FrameClass.VALID, FrameClass.RECOVERY) and key not in seen
        if first:
            seen.add(key)
        yield replace(case, thorough=True) if first else case


def _valid(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for spec in protocol.instructions:
        for step in valid_frames(protocol, spec.name):
            values = step.frame_effect.values
            for _ in range(3):
                setup = setups.next()
                if spec.effect.apply(setup, values) != setup:
                    break  # an instruction that changes nothing could not be observed
            tail = "".join(f"/{value}" for value in values.values())
            yield Case.of(
                step,
                id=f"{FrameClass.VALID}/{spec.name}{tail}",
                requirement=f"{spec.name}: {spec.prose}",
                setup=setup,
                expected=spec.effect.apply(setup, values),
                stop=spec.effect.motion is Motion.STOPPED,
            )


def _faulty(protocol: Protocol, setup: State, ident: str, step: Step, requirement: str) -> Case:
    code = step.accepted[0].codes[0]
    return Case.of(
        step,
        id=f"{step.kind}/{ident}",
        requirement=f"{requirement}: {protocol.codes[code].name}, and the robot stops",
        setup=setup,
        expected=protocol.on_fault.apply(setup),
        stop=True,
    )


def _unused_ids(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for identity in protocol.unused_ids:
        for length in protocol.data_lengths:
            step = unused_id_frame(protocol, identity, length, bytes([protocol.pad_byte]) * length)
            what = f"ID {identity} is unused"
            yield _faulty(protocol, setups.next(), f"{identity}/{length}", step, what)


def _wrong_lengths(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    # Two rotations: too few is rare, and must be tested in each kind of motion too.
    motions = {many: cycle(_motions(protocol)) for many in (True, False)}
    for spec in protocol.instructions:
        for length in protocol.data_lengths:
            if length == spec.length:
                continue
            many = length > spec.length
            step = wrong_length_frame(protocol, spec, length, bytes([protocol.pad_byte]) * length)
            setup = setups.next(next(motions[many]))
            what = f"{spec.name} takes {spec.length} data bytes, not {length}"
            case = _faulty(protocol, setup, f"{spec.name}/{length}", step, what)
            yield replace(case, short=not many)


def _bad_data(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for spec in protocol.instructions:
        for step in bad_data_frames(protocol, spec.name):
            data = step.frame[1:]
            raw = int.from_bytes(data, "big")
            what = f"{spec.name} does not take the data {spaced(data)}"
            yield _faulty(protocol, setups.next(), f"{spec.name}/{raw}", step, what)


def _truncated(protocol: Protocol, setups: _Setups, *, every_cut: bool) -> Iterator[Case]:
    most = protocol.data_lengths[-1]
    for identity, length in protocol.headers:
        spec = protocol.by_id.get(identity)
        own = spec is not None and length == spec.length
        cuts = range(length)
        if not every_cut and not own:
            place = identity % max(1, length)
            cuts = range(place, place + 1) if length == 1 + identity % most else range(0)
        for arrived in cuts:
            step = truncated_frame(protocol, identity, length, bytes([protocol.pad_byte]) * arrived)
            name = spec.name if spec else str(identity)
            ident = f"{name}/{arrived}" if own else f"{name}/{length}/{arrived}"
            what = f"{arrived} of {length} data bytes arrive, then silence"
            yield _faulty(protocol, setups.next(), ident, step, what)


def _recovery(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    """After each class of fault, in each kind of motion, the next valid instruction works."""
    for name, step in _one_of_each(protocol).items():
        for spec in movers(protocol):
            setup = setups.next(spec.effect.motion)
            then = fitted(protocol, spec, setup)
            what = f"after a fault ({name}) {spec.name} works again"
            case = _faulty(protocol, setup, f"{name}/{spec.name}", step, what)
            yield replace(
                case,
                id=f"{FrameClass.RECOVERY}/{name}/{spec.name}",
                clause=protocol.clauses.safety,
                kind=FrameClass.RECOVERY,
                then=then,
                after_then=after(spec, then, protocol.on_fault.apply(setup)),
            )


def _one_of_each(protocol: Protocol) -> dict[str, Step]:
    """One faulty frame of each class."""
    fill = bytes([protocol.pad_byte])
    faults = {}
    if protocol.unused_ids:
        faults[str(FrameClass.UNUSED_ID)] = unused_id_frame(
            protocol, protocol.unused_ids[0], 0, b""
        )
    many = protocol.stop.length + 1
    faults["too-many"] = wrong_length_frame(protocol, protocol.stop, many, fill * many)
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        few = carrying.length - 1
        faults["too-few"] = wrong_length_frame(protocol, carrying, few, fill * few)
        faults[str(FrameClass.TRUNCATED)] = truncated_frame(
            protocol, carrying.id, carrying.length, b""
        )
    bad = [step for s in protocol.instructions for step in bad_data_frames(protocol, s.name)[:1]]
    if bad:
        faults[str(FrameClass.BAD_DATA)] = bad[0]
    return faults
