"""Generates the cases of single frames from the Protocol, and those that open every run.

A case is a value and states its own expectation from the rule that it tests; it never calls
`spec.codec.judge`. (A test checks that the two agree.) Those that open a run are about power-on,
the link and the truncation time-out; `runner.power_on` and `runner.truncation_timeout` run them.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, cycle

from bilprov.conformance.cases.case import Case, runner_case, state_after
from bilprov.conformance.cases.steps import (
    TOO_FEW,
    TOO_MANY,
    FrameClass,
    Step,
    frames_of,
    kind_of,
    one_of_each,
    step_of,
)
from bilprov.conformance.oracle.verdicts import Accepted, Verdict
from bilprov.spec.by_effect import fitted, movers, moving_motions, reached
from bilprov.spec.by_effect import link_check as frames_of_link_check
from bilprov.spec.codec import spaced
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

_VALUES = 1024  # of a variable that are used; those of a wide field are evenly spaced


class _Setups:
    """Start states, drawn so that data and motions rotate through all of their values."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        draw = random.Random(seed)
        self._motions = _blocks(draw, _motions(protocol))
        self._car, fast = protocol.car, protocol.speeds[1]
        # At least half speed: a wheel must be seen to turn, also the inner one of a curve.
        ranges = {name: protocol.limits.get(name, (0, 0)) for name in protocol.settings}
        ranges[self._car.speed] = min(fast, max(1, fast // 2)), fast
        self._values = {
            name: cycle(draw.sample(values := evenly(low, high, _VALUES), len(values)))
            for name, (low, high) in ranges.items()
        }
        self._protocol = protocol

    def next(self, motion: str | None = None) -> State:
        motion = motion or next(self._motions)
        # Steering in a rotation may become a curve (R-steer-rotating): a case tests it, no set-up.
        drawn: dict[str, int | str] = {
            name: next(values)
            for name, values in self._values.items()
            if name != self._car.steering or not self._car.rotates(motion)
        }
        drawn[self._car.by] = motion
        return reached(self._protocol, self._protocol.power_on.but(**drawn))


def _motions(protocol: Protocol) -> tuple[str, ...]:
    """The motions in which frames are tried: those that move, if there are any."""
    return moving_motions(protocol) or (protocol.car.still,)


def _blocks(draw: random.Random, motions: tuple[str, ...]) -> Iterator[str]:
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
        *_faults(protocol, setups, every_cut=every_cut),
        *_recovery(protocol, setups),
    ]
    return tuple(_mark_thorough(found))


def _mark_thorough(found: list[Case]) -> Iterator[Case]:
    """The cases, the first of each class of fault in each kind of motion marked as thorough."""
    seen: set[tuple[FrameClass, int, str]] = set()
    for case in found:
        motion = case.setup.wheels.drive(case.setup).motion
        answer = case.accepted[0].codes[0] if case.kind is FrameClass.WRONG_LENGTH else -1
        key = (case.kind, answer, motion)
        first = case.kind not in (FrameClass.VALID, FrameClass.RECOVERY) and key not in seen
        if first:
            seen.add(key)
        yield replace(case, thorough=True) if first else case


def _valid(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    for step in frames_of(protocol, FrameClass.VALID):
        spec = protocol.by_id[protocol.headers[step.frame[0]][0]]
        for _ in range(3):
            setup = setups.next()
            expected = state_after(protocol, setup, step)
            if expected != setup:
                break  # an instruction that changes nothing could not be observed
        values = "".join(f"/{value}" for value in step.frame_effect.values.values())
        yield Case.of(
            step,
            id=f"{FrameClass.VALID}/{spec.name}{values}",
            requirement=f"{spec.name}: {spec.prose}",
            setup=setup,
            expected=expected,
            stop=protocol.stops(spec.effect),
        )


def _faults(protocol: Protocol, setups: _Setups, *, every_cut: bool) -> Iterator[Case]:
    """Every faulty frame; what comes after a header that is faulty are Stop bytes."""
    # Two rotations: too few is rare, and must be tested in each kind of motion too.
    motions = {kind: cycle(_motions(protocol)) for kind in (TOO_MANY, TOO_FEW)}
    classes = (FrameClass.UNUSED_ID, FrameClass.WRONG_LENGTH, FrameClass.BAD_DATA)
    for step in chain.from_iterable(frames_of(protocol, kind) for kind in classes):
        kind = kind_of(protocol, step)
        setup = setups.next(next(motions[kind]) if kind in motions else None)
        yield replace(_faulty(protocol, setup, step), short=kind == TOO_FEW)
    for step in frames_of(protocol, FrameClass.TRUNCATED):
        if every_cut or _is_sampled(protocol, step):
            yield _faulty(protocol, setups.next(), step)


def _is_sampled(protocol: Protocol, cut: Step) -> bool:
    """Whether a truncation is one of those that stand for all: of each ID, at a place that rotates.

    Of valid headers every truncation is.
    """
    identity, length = protocol.headers[cut.frame[0]]
    spec = protocol.by_id.get(identity)
    if spec is not None and length == spec.length:
        return True
    of_id = length == 1 + identity % protocol.data_lengths[-1]
    return of_id and len(cut.frame) - 1 == identity % length


def _faulty(protocol: Protocol, setup: State, step: Step) -> Case:
    ident, what = _words(protocol, step)
    code = step.accepted[0].codes[0]
    return Case.of(
        step,
        id=f"{step.kind}/{ident}",
        requirement=f"{what}: {protocol.codes[code].name}, and the robot stops",
        setup=setup,
        expected=protocol.on_fault.apply(setup),
        stop=True,
    )


def _words(protocol: Protocol, step: Step) -> tuple[str, str]:
    """The rest of the id of a faulty frame's case, and what is wrong with the frame."""
    identity, length = protocol.headers[step.frame[0]]
    spec, data = protocol.by_id.get(identity), step.frame[1:]
    name = spec.name if spec else str(identity)
    if step.truncated:
        own = spec is not None and length == spec.length
        ident = f"{name}/{len(data)}" if own else f"{name}/{length}/{len(data)}"
        return ident, f"{len(data)} of {length} data bytes arrive, then silence"
    if spec is None:
        return f"{name}/{length}", f"ID {identity} is unused"
    if length != spec.length:
        return f"{name}/{length}", f"{name} takes {spec.length} data bytes, not {length}"
    return f"{name}/{int.from_bytes(data, 'big')}", f"{name} does not take the data {spaced(data)}"


def _recovery(protocol: Protocol, setups: _Setups) -> Iterator[Case]:
    """After each class of fault, in each kind of motion, the next valid instruction works."""
    for name, step in one_of_each(protocol).items():
        for spec in movers(protocol):
            setup = setups.next(protocol.car.motion(spec.effect))
            then = fitted(protocol, spec, setup)
            case = _faulty(protocol, setup, step)
            _, words = case.requirement.split(":", 1)
            yield replace(
                case,
                id=f"{FrameClass.RECOVERY}/{name}/{spec.name}",
                requirement=f"after a fault ({name}) {spec.name} works again:{words}",
                clause=protocol.clauses.safety,
                kind=FrameClass.RECOVERY,
                then=then,
            )


def evenly(low: int, high: int, most: int) -> list[int]:
    """At most so many integers (two or more) from `low` to `high`, both included, evenly spaced."""
    count = min(most, high - low + 1)
    if count == 1:
        return [low]
    return [low + (high - low) * step // (count - 1) for step in range(count)]


def opening_cases(protocol: Protocol) -> tuple[Case, ...]:
    """All opening cases, in the order in which they run."""
    found = (at_rest(protocol), *link_check(protocol), motion_first(protocol))
    return tuple(case for case in (*found, truncation_timeout(protocol)) if case is not None)


def at_rest(protocol: Protocol) -> Case:
    """The case that observes the robot before any byte is sent."""
    requirement = "stands still before the first byte"
    return runner_case(
        protocol, "power-on/at-rest", protocol.clauses.safety, requirement, b"", "R-power-on"
    )


def link_check(protocol: Protocol, taken: int | None = None) -> tuple[Case, ...]:
    """The cases that check the link: a setting, an unused ID, and missing data.

    The setting must not move the robot. `taken` is an unused ID to leave out.
    """
    setting, unused, short = frames_of_link_check(protocol, taken)
    name = kind_of(protocol, step_of(protocol, setting))
    cases = [_answered(protocol, f"power-on/{name}", "a setting does not move it", setting)]
    if unused:
        cases.append(_answered(protocol, "link/unused-id", "an unused ID is refused", unused))
    if short:
        cases.append(_answered(protocol, "link/too-few", "missing data are refused", short))
    return tuple(cases)


def motion_first(protocol: Protocol) -> Case | None:
    """The case of a motion as the first instruction after power-on: a Stop would hide its effect.

    None where every motion takes data.
    """
    spec = next(
        (s for s in protocol.instructions if protocol.car.moves(s.effect) and not s.length), None
    )
    if spec is None:
        return None
    requirement = "a motion as the first instruction is taken; without a speed nothing moves"
    frame = bytes([protocol.header_bytes[spec.id, 0]])
    return _answered(protocol, f"power-on/{spec.name}", requirement, frame, "R-power-on")


def truncation_timeout(protocol: Protocol) -> Case | None:
    """The case of a header whose data never come, with one long wait for its answer.

    None where no instruction takes data.
    """
    spec = next((s for s in protocol.instructions if s.length), None)
    if spec is None:
        return None
    frame = bytes([protocol.header_bytes[spec.id, spec.length]])
    requirement = f"a pause inside {spec.name} ends it and stops the robot"
    ident, reading = "timing/truncation-timeout", "R-truncation-timeout"
    case = _answered(protocol, ident, requirement, frame, reading)
    silent = Accepted((), Verdict.NON_STRICT, "R-truncated-known")
    return replace(case, accepted=(*case.accepted, silent))


def _answered(
    protocol: Protocol, ident: str, requirement: str, frame: bytes, reading: str = ""
) -> Case:
    """A case of one frame, with the answer and the state that are due for it after power-on."""
    step = step_of(protocol, frame)
    case = runner_case(protocol, ident, step.clause, requirement, frame, reading)
    after = state_after(protocol, protocol.power_on, step)
    return replace(case, accepted=step.accepted[:1], expected=after)
