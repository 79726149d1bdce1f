"""Combinations: which frame comes in which state, after which outcome, in which delivery.

The factors are ID, announced length, the classes of the first, second and last data byte, kind of
motion, steering, speed, LED, the outcome before and the delivery. A covering array of strength 3
holds every feasible combination of three of them. Random sequences come after it. Truncated frames
are no part of either (`contexts`).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations, count, islice, product
from typing import Any, NamedTuple

from bilprov.conformance.cases.case import steps_to
from bilprov.conformance.cases.sequence import Burst, SequenceCase, leading
from bilprov.conformance.cases.steps import Inputs, Step, framed, frames_of, step_of
from bilprov.spec.by_effect import moving_motions, setting
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

Row = tuple[int, ...]
"""One value of each factor, by its index."""
Partial = Mapping[int, int]
"""The values chosen so far: value index by factor index."""

_DRAWS = 3  # values drawn for a factor, of which one that covers something new is taken


def feasible_combinations(
    sizes: Sequence[int], strength: int, feasible: Callable[[Partial], bool]
) -> Iterator[tuple[tuple[int, int], ...]]:
    """Yield every feasible combination of the values of `strength` factors, as (factor, value)."""
    for factors in combinations(range(len(sizes)), strength):
        for values in product(*(range(sizes[factor]) for factor in factors)):
            pairs = tuple(zip(factors, values, strict=True))
            if feasible(dict(pairs)):
                yield pairs


class CoveringArray:
    """Rows over factors with `sizes` values each, and what they cover.

    `feasible` says whether values chosen so far can be completed to a row; it must be exact, so
    that a row is never begun in vain. `dear` are (factor, value) pairs that stand in no more rows
    than needed; `rows` hold every feasible combination of `strength` factors, of which there are
    `total`.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        strength: int,
        feasible: Callable[[Partial], bool],
        draw: random.Random,
        *,
        dear: Container[tuple[int, int]] = (),
    ) -> None:
        self._sizes = tuple(sizes)
        self._feasible = feasible
        self._draw = draw
        self._strength = strength
        self._dear = dear
        self._covered: set[tuple[int, ...]] = set()
        # A value's number is unique over all factors, so that a combination is a tuple of numbers.
        self._first = tuple(sum(self._sizes[:index]) for index in range(len(self._sizes)))
        wanted = list(feasible_combinations(sizes, strength, feasible))
        draw.shuffle(wanted)
        self.total = len(wanted)
        self.rows = tuple(self._rows(wanted))

    def _rows(self, wanted: Sequence[tuple[tuple[int, int], ...]]) -> Iterator[Row]:
        first = self._first
        for pairs in wanted:
            if tuple(first[factor] + value for factor, value in pairs) in self._covered:
                continue
            row = self._completed(dict(pairs))
            self._covered.update(self._held(row))
            yield row

    def _held(self, row: Row) -> Iterator[tuple[int, ...]]:
        """The combinations that a row holds."""
        numbers = (base + value for base, value in zip(self._first, row, strict=True))
        return combinations(numbers, self._strength)

    def _completed(self, chosen: dict[int, int]) -> Row:
        """A row with these values; the others are drawn."""
        factors = range(len(self._sizes))
        for factor in factors:
            if factor not in chosen:
                chosen[factor] = self._value(factor, chosen)
        return tuple(chosen[factor] for factor in factors)

    def _value(self, factor: int, chosen: Partial) -> int:
        """A value that can stand beside those chosen, if possible one not covered beside them."""
        sample = self._draw.sample(range(self._sizes[factor]), self._sizes[factor])
        sample.sort(key=lambda value: (factor, value) in self._dear)
        allowed = (value for value in sample if self._feasible({**chosen, factor: value}))
        if factor < self._strength - 1:
            return next(allowed)
        beside = tuple(self._first[one] + chosen[one] for one in range(self._strength - 1))
        values = tuple(islice(allowed, _DRAWS))
        new = ((*beside, self._first[factor] + v) not in self._covered for v in values)
        return next((value for value, fresh in zip(values, new, strict=True) if fresh), values[0])


ARRAY = "combined"
"""What the id of a sequence of an array begins with."""
STRENGTH = 3
"""How many factors' combinations complete frames cover."""

_BOUNDARIES = (0, 1, 127, 128, 255)  # of a byte, signed and unsigned; each a class of its own
_BITS = tuple(1 << bit for bit in range(1, 7))  # the single bits that are no boundary
MARKED = (*_BOUNDARIES, *_BITS)
"""The data bytes with a value of their own: boundaries and single bits."""
_OTHERS = tuple(sorted(set(range(256)) - {*_BOUNDARIES, *_BITS}))
BYTE_CLASSES: tuple[Sequence[int], ...] = (*((value,) for value in _BOUNDARIES), _BITS, _OTHERS)
"""The values of each class of a data byte, which a row numbers from 1; 0 is a byte that is not."""

_CLASS = {value: number for number, some in enumerate(BYTE_CLASSES, 1) for value in some}
# The factors, by their index in a row.
_ID, _LENGTH, _FIRST, _SECOND, _LAST, _STATE = range(6)
# From _STATE on stands each variable of the state, then what was before, and the delivery.
_BEFORE, _WAY = -2, -1
_BYTES = ((_FIRST, 1), (_SECOND, 3), (_LAST, 2))  # and from how many data bytes on each stands
WAITED, PIPELINED, SPLIT = range(3)
DELIVERED, RANDOM = ("waited", "pipelined", "split"), "random"
_STIMULI = 48  # rows of a sequence
_RANDOM_BURSTS = 64  # of a sequence of random frames
_SIZES = (2, 8)  # frames of a random burst, at least and at most


class _Shape(NamedTuple):
    """A frame as far as its values depend on each other: its data bytes and its delivery.

    `lengths` and `way` are the row's values of these two factors.
    """

    lengths: int
    way: int
    length: int


@dataclass(frozen=True)
class Space:
    """The factors of a protocol: the numbers that each value of them stands for."""

    protocol: Protocol
    states: tuple[tuple[str, tuple[Sequence[object], ...]], ...]
    faults: tuple[str, ...]
    shapes: tuple[_Shape, ...]

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """How many values each factor has."""
        data = (len(BYTE_CLASSES) + 1,) * len(_BYTES)
        states = (len(values) for _, values in self.states)
        ids, lengths = len(self.protocol.ids), len(self.protocol.data_lengths)
        return (ids, lengths, *data, *states, 1 + len(self.faults), len(DELIVERED))

    @cached_property
    def way(self) -> int:
        """The factor of the delivery; that of the outcome before is the one before it."""
        return _STATE + len(self.states) + 1

    @cached_property
    def _possible(self) -> dict[tuple[int | None, ...], bool]:
        return {}

    def feasible(self, chosen: Partial) -> bool:
        """Whether a frame in a state can have these values."""
        get = chosen.get
        first, second, last = get(_FIRST, -1), get(_SECOND, -1), get(_LAST, -1)
        # Of a byte it counts whether it is there: 1 is the first of its classes.
        key = (get(_LENGTH), get(self.way), min(first, 1), min(second, 1), min(last, 1))
        possible = self._possible.get(key)
        if possible is None:
            possible = self._possible[key] = any(True for _ in self.fitting(chosen))
        if possible and get(self.way - 1):
            return all(get(factor, only) == only for factor, only in self._left_by_fault)
        return possible

    @cached_property
    def _numbers(self) -> tuple[dict[object, int | None], ...]:
        """For each variable of the state the numbers of the values met so far."""
        return tuple({} for _ in self.states)

    def _number(self, place: int, value: object) -> int | None:
        """The number of a value of the variable at this place, None where it is in no class."""
        numbers = self._numbers[place]
        if value not in numbers:
            classes = enumerate(self.states[place][1])
            numbers[value] = next((number for number, some in classes if value in some), None)
        return numbers[value]

    def row(self, state: State, before: str, step: Step, way: int) -> Row | None:
        """The row of a complete frame that comes in a state; None where a value is in no class.

        `before` is the kind of the fault before it, "" for a valid frame.
        """
        if before and before not in self.faults:
            return None
        identity, length = self.protocol.headers[step.frame[0]]
        places = {_FIRST: 1, _SECOND: 2, _LAST: -1}
        found: tuple[int | None, ...] = (
            self.protocol.ids.index(identity),
            self.protocol.data_lengths.index(length),
            *(_CLASS[step.frame[places[f]]] if length >= least else 0 for f, least in _BYTES),
            *(
                # A variable that no instruction sets alone is no factor, whatever its value.
                self._number(place, getattr(state, name)) if len(values) > 1 else 0
                for place, (name, values) in enumerate(self.states)
            ),
            self.faults.index(before) + 1 if before else 0,
            way,
        )
        known = tuple(number for number in found if number is not None)
        return known if len(known) == len(found) else None

    def fitting(self, chosen: Partial) -> Iterator[_Shape]:
        """The shapes of frames that have the chosen values."""
        for shape in self.shapes:
            if chosen.get(_LENGTH, shape.lengths) == shape.lengths:
                bytes_fit = all(
                    (chosen[factor] > 0) == (shape.length >= least)
                    for factor, least in _BYTES
                    if factor in chosen
                )
                if bytes_fit and chosen.get(self.way, shape.way) == shape.way:
                    yield shape

    @cached_property
    def _left_by_fault(self) -> tuple[tuple[int, int], ...]:
        """The factors that a fault sets, with the value that it gives each."""
        on_fault = self.protocol.on_fault
        left = on_fault.apply(self.protocol.power_on)
        return tuple(
            (factor, number)
            for factor, (name, values) in enumerate(self.states, _STATE)
            for number, some in enumerate(values)
            if on_fault.sets(name) and getattr(left, name) in some
        )


def state_classes(protocol: Protocol) -> tuple[tuple[str, tuple[Sequence[object], ...]], ...]:
    """The variables of the state, with the values of each class of them."""
    car = protocol.car
    motions = tuple((motion,) for motion in (car.still, *moving_motions(protocol)))
    low, high = _limits(protocol, car.steering)
    steerings = (range(low, 0), (0,), range(1, high + 1)) if low < high else ((low,),)
    low, high = _limits(protocol, car.speed)
    half = (low + high + 1) // 2
    speeds = ((low,), range(low + 1, half), range(half, high), (high,)) if low < high else ((low,),)
    classes: dict[str, tuple[Sequence[object], ...]]
    classes = {car.by: motions, car.steering: steerings, car.speed: speeds}
    for name in protocol.lights:
        low, high = _limits(protocol, name)
        bits = [1 << bit for bit in range(high.bit_length())]
        values = range(low, high + 1) if high - low < 8 else sorted({low, high, *bits})
        classes[name] = tuple((value,) for value in values)
    return tuple((name, tuple(filter(len, values))) for name, values in classes.items())


def _limits(protocol: Protocol, variable: str) -> tuple[int, int]:
    """The least and the greatest value that a setting gives a variable."""
    low, high = protocol.limits.get(variable, (0, 0))
    if setting(protocol, variable, low) and setting(protocol, variable, high):
        return low, high
    rest = getattr(protocol.power_on, variable)
    return rest, rest


@lru_cache(maxsize=8)
def space_of(protocol: Protocol) -> Space:
    """The factors of a protocol's complete frames."""
    shapes = tuple(
        _Shape(index, way, length)
        for index, length in enumerate(protocol.data_lengths)
        for way in range(len(DELIVERED))
        if length or way != SPLIT
    )
    return Space(protocol, state_classes(protocol), Inputs(protocol, 0).faulty_kinds, shapes)


@lru_cache(maxsize=8)
def total(protocol: Protocol, strength: int) -> int:
    """How many feasible combinations of so many factors complete frames have."""
    if strength == STRENGTH:
        return _array(protocol)[1]
    space = space_of(protocol)
    return sum(1 for _ in feasible_combinations(space.sizes, strength, space.feasible))


@lru_cache(maxsize=8)
def _array(protocol: Protocol) -> tuple[tuple[Row, ...], int]:
    """The rows of the covering array, and how many combinations they hold.

    They are the same in each run: a run's seed draws their data, and the values of their states.
    """
    space, draw = space_of(protocol), random.Random("combinations")
    dear = {(space.way, SPLIT)}  # a pause each
    array = CoveringArray(space.sizes, STRENGTH, space.feasible, draw, dear=dear)
    return array.rows, array.total


def random_sequences(protocol: Protocol, seed: int, first: int = 1) -> Iterator[SequenceCase]:
    """The sequences of random frames from number `first` on, every second one pipelined.

    They go on from wherever the frames before have led. Each depends on its number and the seed,
    and on no other sequence.
    """
    valid = [list(frames_of(protocol, spec.name)) for spec in protocol.instructions]
    for number in count(first):
        draw = random.Random(f"random sequence {seed} {number}")
        bursts = []
        for _ in range(_RANDOM_BURSTS):
            size = 1 if number % 2 else draw.randint(*_SIZES)
            bursts.append(Burst(tuple(_any_frame(protocol, valid, draw) for _ in range(size))))
        what = "any frame in any state is answered"
        ident = f"{ARRAY}/{RANDOM}/{number:03}"
        yield SequenceCase.of(protocol, ident, what, bursts, seeded=True)


def _any_frame(protocol: Protocol, valid: Sequence[Sequence[Step]], draw: random.Random) -> Step:
    """A random frame: as often one of the valid ones as any header with any data."""
    if draw.random() < 0.5:
        return draw.choice(draw.choice(valid))
    header = draw.randrange(len(protocol.headers))
    data = bytes(draw.choice(draw.choice(BYTE_CLASSES)) for _ in range(protocol.lengths[header]))
    return step_of(protocol, bytes([header]) + data)


class Combinations:
    """The sequences of the rows of one delivery, one of `DELIVERED`; a seed draws their data.

    They begin each frame from a state that was set.
    """

    def __init__(self, protocol: Protocol, seed: int, word: str) -> None:
        self._protocol = protocol
        self._word = word
        self._way = DELIVERED.index(word)
        self._draw = random.Random(f"sequences of combinations {seed} {word}")
        # Each delivery goes on elsewhere in the values of the data of faulty frames.
        self._inputs = Inputs(protocol, seed + self._way)

    def sequences(self) -> Iterator[SequenceCase]:
        """The sequences of these rows."""
        word, space = self._word, space_of(self._protocol)
        rows = [row for row in _array(self._protocol)[0] if row[_WAY] == self._way]
        for number, start in enumerate(range(0, len(rows), _STIMULI), 1):
            what = "each combination of a frame, the state, the outcome before and the delivery"
            bursts, ident = self._bursts(space, rows[start : start + _STIMULI]), f"{ARRAY}/{word}"
            yield SequenceCase.of(self._protocol, f"{ident}/{number:03}", what, bursts, seeded=True)

    def _bursts(self, space: Space, rows: Iterable[Row]) -> Iterator[Burst]:
        """For each row the frames that lead to its state, and its frame."""
        protocol, motion = self._protocol, self._protocol.car.still
        for row in rows:
            before, motion = self._before(row, space, motion)
            step = self._frame(row, space)
            effect = step.frame_effect.effect or protocol.on_fault
            motion = protocol.car.motion(effect) or motion
            if self._way == PIPELINED:
                yield Burst((*before, step))
                continue
            *lead, last = before
            yield from leading(lead)
            yield Burst((last,))
            split = self._way == SPLIT
            yield Burst((step,), (self._draw.randrange(1, len(step.frame)),) if split else ())

    def _before(self, row: Row, space: Space, motion: str) -> tuple[list[Step], str]:
        """The frames that lead from a kind of motion to the row's state, and the motion after."""
        protocol, car, pick = self._protocol, self._protocol.car, self._draw.choice
        drawn: dict[str, Any] = {
            name: pick(values[row[factor]])
            for factor, (name, values) in enumerate(space.states, _STATE)
        }
        fault = row[_BEFORE]
        if fault:
            # The fault is to stop a robot that moves and steers.
            (_, motions), (_, steerings), *_ = space.states
            drawn[car.by] = pick(motions[1:] or motions)[0]
            drawn[car.steering] = pick(pick(steerings))
        state = protocol.power_on.but(**drawn)
        steps = []
        # Steering while it rotates may make a curve of it (R-steer-rotating).
        wanted = car.drive(state).motion
        if wanted not in car.turns or car.rotates(motion):
            steps.append(step_of(protocol, bytes([protocol.pad_byte])))
        steps += steps_to(protocol, state)
        if fault:
            steps.append(self._inputs.next(space.faults[fault - 1]))
            return steps, car.motion(protocol.on_fault) or wanted
        return steps, wanted

    def _frame(self, row: Row, space: Space) -> Step:
        """The frame of a row, its bytes drawn from their classes."""
        protocol, identity = self._protocol, self._protocol.ids[row[_ID]]
        shape = self._draw.choice(list(space.fitting(dict(enumerate(row)))))
        data = bytearray(self._inputs.fill(shape.length))
        for at, factor in ((0, _FIRST), (1, _SECOND), (shape.length - 1, _LAST)):
            if row[factor]:
                data[at] = self._draw.choice(BYTE_CLASSES[row[factor] - 1])
        return framed(protocol, identity, shape.length, bytes(data))
