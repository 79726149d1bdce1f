"""Walks that leave nothing out: every value in every kind of motion, every header, many faults."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle, islice
from typing import TypeVar

from conformance.cases.frame_source import FILLS, Inputs, fill
from conformance.cases.preamble import frames_to, moving_to, setting
from conformance.cases.sequence import Burst, Walk
from conformance.cases.single_frames import moving_motions
from conformance.cases.steps import Step, bad, valid, whole
from spec.codec import all_data, bad_data
from spec.motion import Motion, State
from spec.protocol import Protocol

T = TypeVar("T")

_LENGTH = 64  # bursts of a walk
_ROW, _ROWS = 150, 4  # instructions sent at once: more than a ring of 128 bytes holds


def data_sweep(protocol: Protocol) -> Iterator[Walk]:
    """Every value of every setting while the robot moves, in each kind of motion."""
    for motion in moving_motions(protocol):
        for spec in protocol.instructions:
            if spec.effect.sets("motion") or not spec.fields:
                continue
            values = [
                {f.name: f.parse(data[f.offset : f.offset + f.size]) for f in spec.fields}
                for data in all_data(spec)
            ]
            bursts = [Burst((valid(protocol, spec, value),)) for value in values]
            what = f"{spec.name} takes every value while the robot moves ({motion.value})"
            name = f"sequence/data/{spec.name}-{motion.value}"
            yield from _walks(protocol, name, what, motion, bursts)


def bad_data_sweep(protocol: Protocol) -> Iterator[Walk]:
    """Every value that is out of range, in each kind of motion; each stops the robot."""
    for motion in moving_motions(protocol):
        mover = moving_to(protocol, motion)
        for spec in protocol.instructions:
            steps = [bad(protocol, spec, data) for data in bad_data(spec)]
            if steps and mover is not None:
                what = f"{spec.name} refuses what is out of range, and stops ({motion.value})"
                name = f"sequence/bad-data/{spec.name}-{motion.value}"
                go = valid(protocol, mover, {})
                yield from _walks(protocol, name, what, motion, list(_driven(go, steps)))


def header_sweep(protocol: Protocol) -> Iterator[Walk]:
    """Every header with all the data it announces, filled in three ways, while the robot moves."""
    motions = moving_motions(protocol)
    frame = setting(protocol, "speed", _speed(protocol))
    again = whole(protocol, frame[0], frame[1:]) if frame else None
    for turn in range(FILLS):
        for number, headers in enumerate(_chunks(range(len(protocol.headers)), 32)):
            motion = motions[(turn + number) % len(motions)] if motions else Motion.STOPPED
            mover = moving_to(protocol, motion)
            go = valid(protocol, mover or protocol.stop, {})
            lengths = protocol.lengths
            steps = [whole(protocol, h, fill(protocol, lengths[h], turn)) for h in headers]
            what = "every header with the data it announces gets its answer, and stops if faulty"
            name = f"sequence/headers/{headers[0]:02x}-{turn + 1}"
            yield _walk(protocol, name, what, motion, list(_driven(go, steps, again)))


def dense(protocol: Protocol) -> Walk:
    """Instructions without data in long rows: as many answers as bytes, which fill every buffer."""
    steps = cycle(valid(protocol, spec, {}) for spec in protocol.instructions if not spec.length)
    bursts = [Burst(tuple(islice(steps, _ROW))) for _ in range(_ROWS)]
    what = f"{_ROW} instructions sent at once, each as short as its answer, are all answered"
    return _walk(protocol, "pipelined/dense", what, Motion.STOPPED, bursts)


def faults_in_a_row(protocol: Protocol, seed: int, count: int) -> Walk:
    """As many faults as that, each while the robot moves; each of them stops it."""
    what = f"{count} faults in a row stop it each time"
    bursts = list(_faults(protocol, seed, count))
    return _walk(protocol, "sequence/faults-in-a-row", what, Motion.STOPPED, bursts)


def faults_alone(protocol: Protocol, seed: int, count: int) -> Walk:
    """Faults with nothing valid between them, then a motion: it still takes instructions."""
    inputs = Inputs(protocol, seed)
    kinds = inputs.faulty_kinds
    bursts = [Burst((inputs.next(kinds[index % len(kinds)]),)) for index in range(count)]
    bursts += [Burst((inputs.next(kind),)) for kind in inputs.movers]
    what = f"{count} faults with nothing valid between them are answered, and end nothing"
    return _walk(protocol, "sequence/faults-alone", what, Motion.STOPPED, bursts)


def soak(protocol: Protocol, seed: int, count: int) -> Iterator[Walk]:
    """As many faults as that and as many valid frames, in bursts: for counters that turn over."""
    most = 16
    singles = (burst.steps for burst in _faults(protocol, seed, count))
    pairs = (one + other for one, other in zip(singles, singles, strict=False))
    for number, walk in enumerate(_chunks(_chunks(pairs, most // 2), _LENGTH)):
        bursts = [Burst(tuple(s for pair in chunk for s in pair)) for chunk in walk]
        what = f"{count} faults and as many valid frames change nothing"
        yield _walk(protocol, f"pipelined/soak/{number:04}", what, Motion.STOPPED, bursts)


def _faults(protocol: Protocol, seed: int, count: int) -> Iterator[Burst]:
    """A motion and a fault for each, as they come in turn: two bursts, but in `soak` one."""
    inputs = Inputs(protocol, seed)
    kinds, movers = inputs.faulty_kinds, inputs.movers or inputs.valid_kinds
    for index in range(count):
        yield Burst((inputs.next(movers[index % len(movers)]),), looks=False)
        yield Burst((inputs.next(kinds[index % len(kinds)]),))


def _driven(go: Step, steps: Sequence[Step], again: Step | None = None) -> Iterator[Burst]:
    """Each step while the robot moves; the motion is only looked at where it was not stopped.

    `again` sets the speed anew after a step that has set another, which may be 0.
    """
    for step in steps:
        yield Burst((go,), looks=False)
        yield Burst((step,))
        if again and step.deed.effect and step.deed.effect.sets("speed"):
            yield Burst((again,), looks=False)


def _speed(protocol: Protocol) -> int:
    """A speed at which everything shows."""
    _, fast = protocol.limits.get("speed", (0, 0))
    return fast - fast // 8


def _chunks(values: Iterable[T], size: int) -> Iterator[tuple[T, ...]]:
    left = iter(values)
    while chunk := tuple(islice(left, size)):
        yield chunk


def _walks(
    protocol: Protocol, name: str, what: str, motion: Motion, bursts: Sequence[Burst]
) -> Iterator[Walk]:
    for number, some in enumerate(_chunks(bursts, _LENGTH)):
        yield _walk(protocol, f"{name}/{number + 1}", what, motion, some)


def _walk(
    protocol: Protocol, name: str, what: str, motion: Motion, bursts: Sequence[Burst]
) -> Walk:
    _, led = protocol.limits.get("led", (0, 0))
    state = State(motion=motion, speed=_speed(protocol), steering=0, led=led)
    setup = tuple(whole(protocol, f[0], f[1:]) for f in frames_to(protocol, state))
    return Walk(name, protocol.clauses.instructions, what, setup, tuple(bursts))
