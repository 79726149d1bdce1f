"""The cases, generated from the Protocol: what is sent, what a conforming device then does.

A case is a value and states its own expectation from the rule it stands for; it never asks the
judge. (A test holds that the two agree.)
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import cycle

from conformance.verdicts import Verdict
from spec.codec import all_data, bad_data, lying, spaced
from spec.fields import Outcome
from spec.motion import WHEELS, Motion, State
from spec.protocol import InstructionSpec, Protocol


class Class(StrEnum):
    """The classes of single frames; a case's id begins with it."""

    VALID = "valid"
    UNUSED_ID = "unused-id"
    WRONG_LENGTH = "wrong-length"
    BAD_DATA = "bad-data"
    TRUNCATED = "truncated"
    RECOVERY = "recovery"


@dataclass(frozen=True, slots=True)
class Accepted:
    """A list of answers that may come, the verdict it earns and the reading it rests on."""

    codes: tuple[int, ...]
    verdict: Verdict = Verdict.PASS
    reading: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """One thing to try.

    `setup` is the state the robot is brought to (and, where it moves, seen to move in) before
    `stimulus` is sent; `accepted` are the answer lists that may come back, the expected one
    first; `expected` the state after it, `stop` whether standing still is the point. `arrived` is
    None for whole frames, else the number of data bytes that are sent before the line falls silent.
    `then` is a valid frame that must work right after it. `occasion` (fault, stop, drive or set) is
    what happened, which decides what else the document leaves open about the state. `short` frames
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
    occasion: str = "fault"
    reading: str = ""
    arrived: int | None = None
    then: bytes = b""
    after_then: State | None = None
    short: bool = False
    thorough: bool = False

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
        occasion="set",
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


def _code(protocol: Protocol, outcome: Outcome) -> int:
    return protocol.answers[outcome].code


def _valid(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    accepted = (Accepted((_code(protocol, Outcome.VALID),)),)
    for spec in protocol.instructions:
        for data in all_data(spec):
            values = {f.name: f.parse(data[f.offset : f.offset + f.size]) for f in spec.fields}
            for _ in range(3):
                setup = setups.next()
                if spec.effect.apply(setup, values) != setup:
                    break  # what changes nothing shows nothing
            tail = "".join(f"/{value}" for value in values.values())
            yield Case(
                id=f"{Class.VALID}/{spec.name}{tail}",
                clause=protocol.clauses.instructions,
                requirement=f"{spec.name}: {spec.prose}",
                setup=setup,
                stimulus=lying(protocol, spec.id, spec.length, data),
                accepted=accepted,
                expected=spec.effect.apply(setup, values),
                stop=spec.effect.motion is Motion.STOPPED,
                kind=Class.VALID,
                occasion=_occasion(spec),
            )


def _occasion(spec: InstructionSpec) -> str:
    if spec.effect.motion is None:
        return "set"
    return "stop" if spec.effect.motion is Motion.STOPPED else "drive"


def _faulty(
    protocol: Protocol,
    setup: State,
    ident: str,
    stimulus: bytes,
    kind: Class,
    outcome: Outcome,
    requirement: str,
    clause: str,
    others: tuple[Accepted, ...] = (),
    reading: str = "",
    arrived: int | None = None,
) -> Case:
    return Case(
        id=f"{kind}/{ident}",
        clause=clause,
        requirement=f"{requirement}: {protocol.answers[outcome].name}, and the robot stops",
        setup=setup,
        stimulus=stimulus,
        accepted=(Accepted((_code(protocol, outcome),)), *others),
        expected=protocol.on_fault.apply(setup),
        stop=True,
        kind=kind,
        reading=reading,
        arrived=arrived,
    )


def _non_strict(protocol: Protocol, reading: str, *outcomes: Outcome) -> tuple[Accepted, ...]:
    return tuple(Accepted((_code(protocol, o),), Verdict.NON_STRICT, reading) for o in outcomes)


def _unused_ids(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for identity in protocol.unused_ids:
        for length in protocol.data_lengths:
            others = _non_strict(protocol, "R-unused-length", Outcome.TOO_MANY, Outcome.TOO_FEW)
            yield _faulty(
                protocol,
                setups.next(),
                f"{identity}/{length}",
                lying(protocol, identity, length, bytes([protocol.filler]) * length),
                Class.UNUSED_ID,
                Outcome.UNKNOWN_ID,
                f"ID {identity} is unused",
                protocol.clauses.instructions,
                others if length else (),
                "R-unused-length" if length else "",
            )


def _wrong_lengths(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    # Two rotations: too few is rare, and must meet each kind of motion too.
    motions = {many: cycle(moving_motions(protocol)) for many in (True, False)}
    for spec in protocol.instructions:
        for length in protocol.data_lengths:
            if length == spec.length:
                continue
            many = length > spec.length
            case = _faulty(
                protocol,
                setups.next(next(motions[many])),
                f"{spec.name}/{length}",
                lying(protocol, spec.id, length, bytes([protocol.filler]) * length),
                Class.WRONG_LENGTH,
                Outcome.TOO_MANY if many else Outcome.TOO_FEW,
                f"{spec.name} takes {spec.length} data bytes, not {length}",
                protocol.clauses.responses,
                _competing(protocol, spec, length),
                "R-known-length",
            )
            yield replace(case, short=not many)


def _competing(protocol: Protocol, spec: InstructionSpec, length: int) -> tuple[Accepted, ...]:
    """Data out of range *and* too many: judging the data first is a legal other reading."""
    data = bytes([protocol.filler]) * spec.length
    if length > spec.length and data in set(bad_data(spec)):
        return _non_strict(protocol, "R-competing-errors", Outcome.BAD_DATA)
    return ()


def _bad_data(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for spec in protocol.instructions:
        for data in bad_data(spec):
            raw = int.from_bytes(data, "big")
            yield _faulty(
                protocol,
                setups.next(),
                f"{spec.name}/{raw}",
                lying(protocol, spec.id, spec.length, data),
                Class.BAD_DATA,
                Outcome.BAD_DATA,
                f"{spec.name} does not take the data {spaced(data)}",
                protocol.clauses.instructions,
                reading=next((f.reading for f in spec.fields if f.reading), ""),
            )


def _truncated(protocol: Protocol, setups: _Setups, *, every_cut: bool) -> Iterator[Case]:
    turn = 0
    for header in range(len(protocol.headers)):
        identity, length = protocol.headers[header]
        spec = protocol.by_id.get(identity)
        whole = spec is not None and length == spec.length
        cuts = range(length)
        if not every_cut and not whole and length:
            cuts = range(turn % length, turn % length + 1)
            turn += 1
        for arrived in cuts:
            if spec is None:
                outcome, name = Outcome.UNKNOWN_ID, str(identity)
                others = (
                    *_non_strict(protocol, "R-truncated-unused", Outcome.TOO_FEW),
                    *_non_strict(protocol, "R-unused-length", Outcome.TOO_MANY),
                )
                reading = "R-truncated-unused"
            else:
                outcome, name = Outcome.TOO_FEW, spec.name
                long = length > spec.length
                others = _non_strict(protocol, "R-truncated-long", Outcome.TOO_MANY) if long else ()
                reading = "R-truncated-long" if long else "R-truncated-known"
            silent = Accepted((), Verdict.NON_STRICT, "R-truncated-known")
            yield _faulty(
                protocol,
                setups.next(),
                f"{name}/{arrived}" if whole else f"{name}/{length}/{arrived}",
                lying(protocol, identity, length, bytes([protocol.filler]) * arrived),
                Class.TRUNCATED,
                outcome,
                f"{arrived} of {length} data bytes arrive, then silence",
                protocol.clauses.responses if spec else protocol.clauses.instructions,
                (*others, silent),
                reading,
                arrived,
            )


def _recovery(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    """After each class of fault, in each kind of motion, the next valid instruction works."""
    wrong = protocol.header_bytes
    carrying = next((s for s in protocol.instructions if s.length), None)
    faults: dict[str, tuple[bytes, Outcome, int | None]] = {}
    if protocol.unused_ids:
        frame = bytes([wrong[protocol.unused_ids[0], 0]])
        faults[Class.UNUSED_ID] = (frame, Outcome.UNKNOWN_ID, None)
    many = protocol.stop.length + 1
    frame = lying(protocol, protocol.stop.id, many, bytes([protocol.filler]) * many)
    faults["too-many"] = (frame, Outcome.TOO_MANY, None)
    if carrying:
        few = lying(protocol, carrying.id, carrying.length - 1)
        few += bytes([protocol.filler]) * (carrying.length - 1)
        faults["too-few"] = (few, Outcome.TOO_FEW, None)
        cut = lying(protocol, carrying.id, carrying.length)
        faults[Class.TRUNCATED] = (cut, Outcome.TOO_FEW, 0)
    limited = next((s for s in protocol.instructions if any(True for _ in bad_data(s))), None)
    if limited:
        data = next(iter(bad_data(limited)))
        frame = lying(protocol, limited.id, limited.length, data)
        faults[Class.BAD_DATA] = (frame, Outcome.BAD_DATA, None)
    for name, (stimulus, outcome, arrived) in faults.items():
        for spec in protocol.instructions:
            motion = spec.effect.motion
            if spec.fields or motion in (None, Motion.STOPPED):
                continue
            setup = setups.next(motion)
            after = protocol.on_fault.apply(setup)
            case = _faulty(
                protocol,
                setup,
                f"{name}/{spec.name}",
                stimulus,
                Class.RECOVERY,
                outcome,
                f"after a fault ({name}) {spec.name} works again",
                protocol.clauses.safety,
                (Accepted((), Verdict.NON_STRICT, "R-truncated-known"),) if arrived == 0 else (),
                arrived=arrived,
            )
            then = lying(protocol, spec.id, 0)
            yield replace(case, then=then, after_then=spec.effect.apply(after))
