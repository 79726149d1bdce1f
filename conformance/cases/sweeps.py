"""Exhaustive sequences: every value in every kind of motion, every header, many faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle, islice

from bilprov.conformance.cases.case import in_motion, steps_to
from bilprov.conformance.cases.sequence import Burst, SequenceCase, chunks
from bilprov.conformance.cases.steps import (
    FILLS,
    FrameClass,
    Inputs,
    Step,
    fill,
    framed,
    frames_of,
    step_of,
)
from bilprov.spec.by_effect import moving_motions, moving_to, setting
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

_LENGTH = 64  # bursts of a sequence
_AGAIN = 20  # times that an instruction comes in a row
_ROW, _ROWS = 150, 4  # instructions sent at once: more than a ring of 128 bytes holds


def data_sweep(protocol: Protocol) -> Iterator[SequenceCase]:
    """Every value of every setting while the robot moves, in each kind of motion."""
    for motion in moving_motions(protocol):
        for spec in protocol.instructions:
            if spec.effect.sets(protocol.car.by) or not spec.fields:
                continue
            bursts = [Burst((step,)) for step in frames_of(protocol, spec.name)]
            what = f"{spec.name} takes every value while the robot moves ({motion})"
            name = f"sequence/data/{spec.name}-{motion}"
            yield from _sequences(protocol, name, what, motion, bursts)


def bad_data_sweep(protocol: Protocol) -> Iterator[SequenceCase]:
    """Every value that is out of range, in each kind of motion; each stops the robot."""
    for motion in moving_motions(protocol):
        go = _moving(protocol, motion)
        for spec in protocol.instructions:
            bad = frames_of(protocol, FrameClass.BAD_DATA)
            steps = [s for s in bad if protocol.headers[s.frame[0]][0] == spec.id]
            if steps:
                what = f"{spec.name} refuses what is out of range, and stops ({motion})"
                name = f"sequence/bad-data/{spec.name}-{motion}"
                yield from _sequences(protocol, name, what, motion, list(_driven(go, steps)))


def header_sweep(protocol: Protocol) -> Iterator[SequenceCase]:
    """Every header with all the data it announces, filled in three ways, while the robot moves."""
    motions = moving_motions(protocol)
    frame = setting(protocol, protocol.car.speed, _speed(protocol))
    again = step_of(protocol, frame) if frame else None
    for turn in range(FILLS):
        for number, headers in enumerate(chunks(enumerate(protocol.headers), 32)):
            motion = motions[(turn + number) % len(motions)] if motions else protocol.car.still
            go = _moving(protocol, motion)
            steps = [framed(protocol, i, n, fill(protocol, n, turn)) for _, (i, n) in headers]
            what = "every header with the data it announces gets its answer, and stops if faulty"
            name = f"sequence/headers/{headers[0][0]:02x}-{turn + 1}"
            yield _sequence(
                protocol, name, what, motion, list(_driven(go, steps, again, protocol.car.speed))
            )


def dense(protocol: Protocol) -> SequenceCase:
    """A sequence of long rows of instructions without data, one answer a byte, to fill buffers."""
    steps = cycle(framed(protocol, s.id, 0, b"") for s in protocol.instructions if not s.length)
    bursts = [Burst(tuple(islice(steps, _ROW))) for _ in range(_ROWS)]
    what = f"{_ROW} instructions sent at once, each as short as its answer, are all answered"
    return _sequence(protocol, "pipelined/dense", what, protocol.car.still, bursts)


def faults_in_a_row(protocol: Protocol, seed: int, count: int) -> SequenceCase:
    """A sequence of `count` faults, each sent while the robot moves; each must stop it."""
    what = f"{count} faults in a row stop it each time"
    bursts = list(_faults(protocol, seed, count))
    return _sequence(protocol, "sequence/faults-in-a-row", what, protocol.car.still, bursts)


def faults_alone(protocol: Protocol, seed: int, count: int) -> SequenceCase:
    """A sequence of `count` faults with nothing valid between them, then motions that must work."""
    inputs = Inputs(protocol, seed)
    kinds = inputs.faulty_kinds
    bursts = [Burst((inputs.next(kinds[index % len(kinds)]),)) for index in range(count)]
    bursts += [Burst((inputs.next(kind),)) for kind in inputs.movers]
    what = f"{count} faults with nothing valid between them are answered, and change nothing else"
    return _sequence(protocol, "sequence/faults-alone", what, protocol.car.still, bursts)


def again_and_again(protocol: Protocol, seed: int) -> Iterator[SequenceCase]:
    """Each instruction many times in a row, with other data, while the robot moves at first."""
    inputs = Inputs(protocol, seed)
    motion = next(iter(moving_motions(protocol)), protocol.car.still)
    for name in inputs.valid_kinds:
        bursts = [Burst((inputs.next(name),)) for _ in range(_AGAIN)]
        what = f"{name} is carried out each time, {_AGAIN} times in a row"
        yield _sequence(protocol, f"sequence/again/{name}", what, motion, bursts)


def soak(protocol: Protocol, seed: int, count: int) -> Iterator[SequenceCase]:
    """Sequences of `count` faults and as many valid frames, in bursts, to overflow counters."""
    most = 16
    singles = (burst.steps for burst in _faults(protocol, seed, count))
    pairs = (one + other for one, other in zip(singles, singles, strict=False))
    for number, sequence in enumerate(chunks(chunks(pairs, most // 2), _LENGTH)):
        bursts = [Burst(tuple(s for pair in chunk for s in pair)) for chunk in sequence]
        what = f"{count} faults and as many valid frames change nothing"
        yield _sequence(protocol, f"pipelined/soak/{number:04}", what, protocol.car.still, bursts)


def _faults(protocol: Protocol, seed: int, count: int) -> Iterator[Burst]:
    """`count` times a motion and a fault, each kind in turn: two bursts, which `soak` joins."""
    inputs = Inputs(protocol, seed)
    kinds, movers = inputs.faulty_kinds, inputs.movers or inputs.valid_kinds
    for index in range(count):
        yield Burst((inputs.next(movers[index % len(movers)]),), looks=False)
        yield Burst((inputs.next(kinds[index % len(kinds)]),))


def _driven(
    go: Step, steps: Sequence[Step], again: Step | None = None, speed: str = ""
) -> Iterator[Burst]:
    """Each step in a burst after one with the motion `go`; the robot is observed after the step.

    `again` sets the `speed` anew after a step that has set another, which may be 0.
    """
    for step in steps:
        yield Burst((go,), looks=False)
        yield Burst((step,))
        if again and step.frame_effect.effect and step.frame_effect.effect.sets(speed):
            yield Burst((again,), looks=False)


def _moving(protocol: Protocol, motion: str) -> Step:
    """The frame that sets a robot into a motion, the stop for the motion `stopped`."""
    frame = moving_to(protocol, _state(protocol, motion))
    return step_of(protocol, frame or bytes([protocol.pad_byte]))


def _state(protocol: Protocol, motion: str) -> State:
    """A state in this motion, fast and straight on, with every light."""
    lights = {name: protocol.limits.get(name, (0, 0))[1] for name in protocol.lights}
    return in_motion(protocol, motion, _speed(protocol), lights)


def _speed(protocol: Protocol) -> int:
    """A speed high enough for every effect on the wheels to be observed."""
    fast = protocol.speeds[1]
    return fast - fast // 8


def _sequences(
    protocol: Protocol, name: str, what: str, motion: str, bursts: Sequence[Burst]
) -> Iterator[SequenceCase]:
    for number, some in enumerate(chunks(bursts, _LENGTH)):
        yield _sequence(protocol, f"{name}/{number + 1}", what, motion, some)


def _sequence(
    protocol: Protocol, name: str, what: str, motion: str, bursts: Sequence[Burst]
) -> SequenceCase:
    setup = steps_to(protocol, _state(protocol, motion))
    return SequenceCase.of(protocol, name, what, bursts, setup=setup)
