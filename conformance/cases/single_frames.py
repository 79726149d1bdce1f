"""The cases, generated from the Protocol: what is sent, what a conforming device then does.

A case is a value and states its own expectation from the rule it stands for; it never asks the
judge. (A test holds that the two agree.)
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import cycle

from conformance.cases.steps import Accepted, Class, Step, bad, cut, unused, valid, wrong_length
from conformance.oracle.state_model import FAULT, NOTHING, Deed
from spec.codec import all_data, bad_data, lying, spaced
from spec.motion import WHEELS, Motion, State
from spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Case:
    """One thing to try.

    `setup` is the state the robot is brought to (and, where it moves, seen to move in) before
    `stimulus` is sent; `accepted` are the answer lists that may come back, the expected one
    first; `deed` is what the stimulus does and `expected` the reference's state after it, `stop`
    whether standing still is the point. `arrived` is None for whole frames, else the number of data
    bytes that are sent before the line falls silent. `then` is a valid frame that must work right
    after it. `point` is the silence of the document that the answer rests on. `short` frames
    announce less than the instruction takes: a device must not take the next byte for its data.
    `thorough` cases hold the stop longer and are the ones that are looked at when looks are dear.
    """

    id: str
    clause: str
    requirement: str
    setup: State
    stimulus: bytes
    accepted: tuple[Accepted, ...]
    expected: State
    stop: bool
    kind: Class
    deed: Deed = FAULT
    reading: str = ""
    point: str = ""
    arrived: int | None = None
    then: bytes = b""
    after_then: State | None = None
    short: bool = False
    thorough: bool = False

    @property
    def step(self) -> Step:
        """The stimulus as a step."""
        return Step(
            self.stimulus,
            self.kind,
            self.accepted,
            self.deed,
            self.clause,
            self.point,
            self.reading,
            self.arrived is not None,
        )

    def as_step(self, step: Step) -> Case:
        """The case with another step in the place of its stimulus."""
        return replace(
            self,
            stimulus=step.frame,
            kind=step.kind,
            accepted=step.accepted,
            deed=step.deed,
            point=step.point,
            arrived=len(step.frame) - 1 if step.cut else None,
            stop=self.stop and step.faulty if self.step.faulty else self.stop or step.faulty,
        )

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The frames that the case sends, without what brings it about."""
        return (self.stimulus, self.then) if self.then else (self.stimulus,)


def special(
    protocol: Protocol,
    ident: str,
    clause: str,
    requirement: str,
    stimulus: bytes,
    reading: str = "",
) -> Case:
    """A case that the runner itself stands for: no answers or state expected yet."""
    return Case(
        id=ident,
        clause=clause,
        requirement=requirement,
        setup=protocol.power_on,
        stimulus=stimulus,
        accepted=(),
        expected=protocol.power_on,
        stop=False,
        kind=Class.VALID,
        deed=NOTHING,
        reading=reading,
    )


class _Setups:
    """States to start from, so that data and motions rotate through all of their values."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        draw = random.Random(seed)
        self._motions = _blocks(draw, moving_motions(protocol))
        top = {name: high for name, (_, high) in protocol.limits.items()}
        low = {name: least for name, (least, _) in protocol.limits.items()}
        fast = top.get("speed", 0)
        # At least half speed: a wheel must be seen to turn, also the inner one of a curve.
        self._speeds = cycle(_shuffled(draw, range(max(1, fast // 2), fast + 1)))
        self._steers = cycle(
            _shuffled(draw, range(low.get("steering", 0), top.get("steering", 0) + 1))
        )
        self._leds = cycle(_shuffled(draw, range(low.get("led", 0), top.get("led", 0) + 1)))
        self._power_on = protocol.power_on

    def next(self, motion: Motion | None = None) -> State:
        motion = motion or next(self._motions)
        # Steering during a rotation may become a curve (R-steer-rotating): it is a case, no set-up.
        steers = WHEELS[motion][0] == WHEELS[motion][1]
        return replace(
            self._power_on,
            motion=motion,
            speed=next(self._speeds),
            steering=next(self._steers) if steers else self._power_on.steering,
            led=next(self._leds),
        )


def _blocks(draw: random.Random, motions: tuple[Motion, ...]) -> Iterator[Motion]:
    """Each motion as often as the others, in no fixed step with what is sent."""
    while True:
        yield from draw.sample(motions, len(motions))


def _shuffled(draw: random.Random, values: range) -> list[int]:
    return draw.sample(values, len(values))


def moving_motions(protocol: Protocol) -> tuple[Motion, ...]:
    """The kinds of motion that some instruction without data sets."""
    found = {spec.effect.motion for spec in protocol.instructions if not spec.fields}
    return tuple(m for m in Motion if m in found and m is not Motion.STOPPED)


def all_cases(protocol: Protocol, seed: int, *, every_cut: bool) -> tuple[Case, ...]:
    """Every single-frame case and the recovery from each class.

    `every_cut` takes each truncation of each header (virtual time); else one cut per header,
    rotated, and every cut of the valid headers (real time: each costs a time-out).
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
    """The first case of each class of fault in each kind of motion is a thorough one."""
    seen: set[tuple[Class, int, Motion]] = set()
    for case in found:
        answer = case.accepted[0].codes[0] if case.kind is Class.WRONG_LENGTH else -1
        key = (case.kind, answer, case.setup.motion)
        first = case.kind not in (Class.VALID, Class.RECOVERY) and key not in seen
        if first:
            seen.add(key)
        yield replace(case, thorough=True) if first else case


def _valid(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for spec in protocol.instructions:
        for data in all_data(spec):
            values = {f.name: f.parse(data[f.offset : f.offset + f.size]) for f in spec.fields}
            for _ in range(3):
                setup = setups.next()
                if spec.effect.apply(setup, values) != setup:
                    break  # what changes nothing shows nothing
            step = valid(protocol, spec, values)
            tail = "".join(f"/{value}" for value in values.values())
            yield Case(
                id=f"{Class.VALID}/{spec.name}{tail}",
                clause=step.clause,
                requirement=f"{spec.name}: {spec.prose}",
                setup=setup,
                stimulus=step.frame,
                accepted=step.accepted,
                expected=spec.effect.apply(setup, values),
                stop=spec.effect.motion is Motion.STOPPED,
                kind=Class.VALID,
                deed=step.deed,
            )


def _faulty(
    protocol: Protocol,
    setup: State,
    ident: str,
    step: Step,
    requirement: str,
    arrived: int | None = None,
) -> Case:
    code = step.accepted[0].codes[0]
    return Case(
        id=f"{step.kind}/{ident}",
        clause=step.clause,
        requirement=f"{requirement}: {protocol.codes[code].name}, and the robot stops",
        setup=setup,
        stimulus=step.frame,
        accepted=step.accepted,
        expected=protocol.on_fault.apply(setup),
        stop=True,
        kind=step.kind,
        reading=step.reading,
        point=step.point,
        arrived=arrived,
    )


def _unused_ids(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for identity in protocol.unused_ids:
        for length in protocol.data_lengths:
            step = unused(protocol, identity, length, bytes([protocol.filler]) * length)
            what = f"ID {identity} is unused"
            yield _faulty(protocol, setups.next(), f"{identity}/{length}", step, what)


def _wrong_lengths(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    # Two rotations: too few is rare, and must meet each kind of motion too.
    motions = {many: cycle(moving_motions(protocol)) for many in (True, False)}
    for spec in protocol.instructions:
        for length in protocol.data_lengths:
            if length == spec.length:
                continue
            many = length > spec.length
            step = wrong_length(protocol, spec, length, bytes([protocol.filler]) * length)
            setup = setups.next(next(motions[many]))
            what = f"{spec.name} takes {spec.length} data bytes, not {length}"
            case = _faulty(protocol, setup, f"{spec.name}/{length}", step, what)
            yield replace(case, short=not many)


def _bad_data(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for spec in protocol.instructions:
        for data in bad_data(spec):
            raw = int.from_bytes(data, "big")
            what = f"{spec.name} does not take the data {spaced(data)}"
            step = bad(protocol, spec, data)
            yield _faulty(protocol, setups.next(), f"{spec.name}/{raw}", step, what)


def _truncated(protocol: Protocol, setups: _Setups, *, every_cut: bool) -> Iterator[Case]:
    turn = 0
    for identity, length in protocol.headers:
        spec = protocol.by_id.get(identity)
        own = spec is not None and length == spec.length
        cuts = range(length)
        if not every_cut and not own and length:
            cuts = range(turn % length, turn % length + 1)
            turn += 1
        for arrived in cuts:
            step = cut(protocol, identity, length, bytes([protocol.filler]) * arrived)
            name = spec.name if spec else str(identity)
            ident = f"{name}/{arrived}" if own else f"{name}/{length}/{arrived}"
            what = f"{arrived} of {length} data bytes arrive, then silence"
            yield _faulty(protocol, setups.next(), ident, step, what, arrived)


def _recovery(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    """After each class of fault, in each kind of motion, the next valid instruction works."""
    for name, step in _one_of_each(protocol).items():
        for spec in protocol.instructions:
            motion = spec.effect.motion
            if spec.fields or motion in (None, Motion.STOPPED):
                continue
            setup = setups.next(motion)
            after = protocol.on_fault.apply(setup)
            what = f"after a fault ({name}) {spec.name} works again"
            arrived = len(step.frame) - 1 if step.cut else None
            case = _faulty(protocol, setup, f"{name}/{spec.name}", step, what, arrived)
            yield replace(
                case,
                id=f"{Class.RECOVERY}/{name}/{spec.name}",
                clause=protocol.clauses.safety,
                kind=Class.RECOVERY,
                then=lying(protocol, spec.id, 0),
                after_then=spec.effect.apply(after),
            )


def _one_of_each(protocol: Protocol) -> dict[str, Step]:
    """One faulty frame of each class."""
    fill = bytes([protocol.filler])
    faults = {}
    if protocol.unused_ids:
        faults[str(Class.UNUSED_ID)] = unused(protocol, protocol.unused_ids[0], 0, b"")
    many = protocol.stop.length + 1
    faults["too-many"] = wrong_length(protocol, protocol.stop, many, fill * many)
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        few = carrying.length - 1
        faults["too-few"] = wrong_length(protocol, carrying, few, fill * few)
        faults[str(Class.TRUNCATED)] = cut(protocol, carrying.id, carrying.length, b"")
    limited = next((s for s in protocol.instructions if any(True for _ in bad_data(s))), None)
    if limited:
        faults[str(Class.BAD_DATA)] = bad(protocol, limited, next(iter(bad_data(limited))))
    return faults
