"""Contexts: frames right after each kind of frame, while the robot moves, with data that rotate.

Complete frames come after every kind of frame, with the marked values of a byte and with all of
them in turn. Truncated frames do so too, and share their time-outs: in one of them the robot is
watched for what the frame before may still do, and after it comes a frame that is in context as
well. Some frames are followed by a silence.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import chain, count, cycle, product
from math import ceil
from typing import Any, NamedTuple

from bilprov.conformance.cases.case import state_after, steps_to
from bilprov.conformance.cases.combinations import MARKED, state_classes
from bilprov.conformance.cases.sequence import Burst, SequenceCase, chunks, leading
from bilprov.conformance.cases.steps import FrameClass, Inputs, Step, framed, frames_of, step_of
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

AFTER, CUT, ALONE = "combined/after", "combined/cut", "sequence/left-alone"
"""The groups of complete frames, of truncated ones, and of those that are followed by silence."""

_CONTEXTS, _CUTS, _ALONE = 48, 24, 11  # of a sequence
_WAITED = 12  # sequences of contexts of which one is not pipelined
_ONE_AFTER_ANOTHER = 5  # truncated frames of which one comes right after another
_ARRIVE = (0, *4 * (1,), *4 * (2,), *3 * (3,), 5)  # data bytes of the cut frames of each ID
_SETS_ALL = 0.4  # share of the contexts that set the whole state, not the motion alone
# ms without a frame: what a fault leaves shows late, at 120, at 60, and what comes after 30, at 15.
_LONG, _SHORT, _PAUSE, _BRIEF = 122, 62, 31, 16
_REST = 310  # ms for which it drives before a fault comes: what falls asleep does so within 300
_ODD = 83  # from one value of a byte to the next: no value is met twice before all are


_Context = tuple[str, Step]
"""The kind of the frame right before a frame under test, and that frame."""


class _Silence(NamedTuple):
    """Two kinds of frames, and for how long (ms) the robot is left alone after them.

    `end` is the kind of the frame that ends the silence, "" for each kind in turn. `ahead` where
    the second frame is sent without waiting for the answer to the first; else it comes `rest` (ms)
    after this.
    """

    first: str
    second: str
    dwell: int
    end: str = ""
    ahead: bool = False
    rest: int = 0


def after_each_kind(protocol: Protocol, seed: int, turns: int) -> Iterator[SequenceCase]:
    """The sequences of complete frames in context, `turns` times with other states and data.

    Most are pipelined: each frame under test with those that lead to it. In one of `_WAITED` it
    and the frame before it are sent once the answer before has come.
    """
    numbers = count(1)
    for turn in range(turns):
        draw = random.Random(f"contexts {seed} {turn}")
        walk = _Walk(protocol, draw, Inputs(protocol, seed + turn))
        contexts = list(_complete(protocol, walk.inputs, turn))
        draw.shuffle(contexts)
        for some, number in zip(chunks(contexts, _CONTEXTS), numbers, strict=False):
            walk.begin()
            bursts: list[Burst] = []
            for kind, frame in some:
                *lead, before = walk.lead(kind)
                step = walk.took(frame)
                if number % _WAITED:
                    bursts.append(Burst((*lead, before, step)))
                else:
                    bursts += (*leading(lead), Burst((before,)), Burst((step,)))
            what = "each frame is answered right after each kind of frame, whatever its data"
            ident = f"{AFTER}/{number:03}"
            yield SequenceCase.of(protocol, ident, what, bursts, seeded=True)


def truncations(protocol: Protocol, seed: int, turns: int) -> Iterator[SequenceCase]:
    """The sequences of truncated frames: `turns` times each ID with each number of bytes.

    Each comes after a pair of kinds, or right after another truncated one, and before a frame that
    is right after a truncated one.
    """
    numbers = count(1)
    for turn in range(turns):
        draw = random.Random(f"truncations {seed} {turn}")
        walk = _Walk(protocol, draw, Inputs(protocol, seed + turn))
        cuts = list(_cut(protocol, draw))
        draw.shuffle(cuts)
        kinds = walk.inputs.kinds
        pairs = cycle(draw.sample(list(product(kinds, kinds)), len(kinds) ** 2))
        following = cycle(_after_cuts(protocol, draw))
        for some, number in zip(chunks(cuts, _CUTS), numbers, strict=False):
            walk.begin()
            bursts: list[Burst] = []
            for place, cut in enumerate(some, 1):
                if place % _ONE_AFTER_ANOTHER:
                    first, second = next(pairs)
                    bursts += leading(walk.lead(first))
                    bursts.append(Burst((walk.took(walk.inputs.next(second)),)))
                bursts.append(Burst((walk.took(cut),)))
                if (place + 1) % _ONE_AFTER_ANOTHER or place == len(some):
                    bursts.append(Burst((walk.took(next(following)),)))
            what = (
                "a frame that is cut short stops it, whatever came before, and changes nothing else"
            )
            ident = f"{CUT}/{number:03}"
            yield SequenceCase.of(protocol, ident, what, bursts, seeded=True)


def left_alone(protocol: Protocol, seed: int, turns: int) -> Iterator[SequenceCase]:
    """The sequences of frames after which the robot is sent nothing for a time.

    They are faults while it moves, after each kind that lets it move, every second kind of them
    also after it has moved for a time without a frame; and each valid kind, while it moves or
    stands. A frame of each kind in turn ends the silences, and each kind a short one in each
    motion. Half of the frames are sent ahead of the answer before. In further `turns` all of them
    come again, those sent ahead and those not changing places, with other data and states, some
    with a pause between their bytes; faults come while it stands too, valid kinds in each motion,
    and what each frame after a silence leaves is watched.
    """
    numbers = count(1)
    for turn in range(turns):
        draw = random.Random(f"left alone {seed} {turn}")
        walk = _Walk(protocol, draw, Inputs(protocol, seed + turn))
        inputs = walk.inputs
        contexts = list(_silences(protocol, inputs, turn))
        draw.shuffle(contexts)
        # A silence while it moves, and one while it stands, are each ended by all kinds in turn.
        ends = [cycle(draw.sample(inputs.kinds, len(inputs.kinds))) for _ in range(2)]
        watched = inputs.kinds if turn else (protocol.stop.name, *inputs.faulty_kinds)
        for some, number in zip(chunks(contexts, _ALONE), numbers, strict=False):
            walk.begin()
            bursts: list[Burst] = []
            for one in some:
                *lead, last = walk.lead(one.first)
                bursts += leading(lead)
                step = walk.took(inputs.next(one.second))
                if not one.ahead:
                    bursts.append(Burst((last,), looks=one.rest > 0, idle_ms=one.rest))
                alone = (last, step) if one.ahead else (step,)
                whole = not turn or one.ahead or step.truncated or len(step.frame) == 1
                pauses = () if whole or draw.random() < 0.5 else (1,)
                bursts.append(Burst(alone, pauses, idle_ms=one.dwell))
                end = one.end or next(ends[walk.moving])
                dwell = _BRIEF if end in watched else 0
                bursts.append(Burst((walk.took(inputs.next(end)),), idle_ms=dwell))
            what = "the effect of a frame lasts while nothing else is sent"
            ident = f"{ALONE}/{number:03}"
            yield SequenceCase.of(protocol, ident, what, bursts, seeded=True)


def _silences(protocol: Protocol, inputs: Inputs, turn: int) -> Iterator[_Silence]:
    """The silences of one turn."""
    stop, movers = protocol.stop.name, inputs.movers
    # The first time what shows best: faults while it moves.
    before = (*inputs.settings, *movers, *([stop] if turn else [])) or (stop,)
    for row, first in enumerate(before, turn):
        for place, fault in enumerate((*inputs.faulty_kinds, FrameClass.TRUNCATED), row):
            dwell = _LONG if place % 3 == 0 else _SHORT
            yield _Silence(first, fault, dwell, ahead=place % 2 == 0)
    for place, fault in enumerate(inputs.faulty_kinds[turn % 2 :: 2], turn):
        yield _Silence(before[place % len(before)], fault, _SHORT, rest=_REST)
    going = [stop, *movers[turn // 2 % max(1, len(movers)) :][:1]]
    ways = cycle(going[::-1] if turn % 2 else going)
    for place, kind in enumerate(inputs.valid_kinds, turn):
        for first in (stop, *movers) if turn else (next(ways),):
            yield _Silence(first, kind, _SHORT, ahead=place // 2 % 2 == 0)
    settings = cycle(inputs.settings or movers)
    for row, mover in enumerate(movers, turn):
        for place, end in enumerate(inputs.kinds, row):
            pair = mover, next(settings)
            # In each motion: half of the times it has just begun, half of them a setting came last.
            first, second = pair if place % 2 else pair[::-1]
            dwell = (_PAUSE, _BRIEF)[row % 2]
            yield _Silence(first, second, dwell, end, ahead=place // 2 % 2 == 0)


def _complete(protocol: Protocol, inputs: Inputs, turn: int) -> Iterator[_Context]:
    """Each complete frame under test with the kind that comes right before it.

    Each faulty header comes after each kind with marked values. Then it comes while the robot moves
    with all values of a byte in turn, which the headers of one ID, or of one length of unused IDs,
    meet together. Each setting comes after each kind with its marked values, each valid frame once
    more.
    """
    kinds, moving = inputs.kinds, (*inputs.settings, *inputs.movers) or inputs.kinds
    unused, longest = protocol.unused_ids, protocol.data_lengths[-1]
    for identity, length in _faulty_headers(protocol):
        spec = protocol.by_id.get(identity)
        # How many headers with data share the values: of one ID, or of one length of unused IDs.
        if spec is None:
            beside = min(longest, len(unused) + 2)
        else:
            beside = longest - spec.length if length > spec.length else spec.length - 1
        # The shortest two have no second byte beside the first and the last.
        visits = ceil(256 / max(1, beside - 2)) if length else 0
        place = identity + length
        for number, kind in enumerate(kinds):
            data = _marked(length, place + number + turn)
            yield kind, framed(protocol, identity, length, data)
        for visit in range(visits):
            # In turn each of the 256 values stands first, second and last.
            start = _ODD * (visit + visits * (place + turn))
            values = [(start + 97 * at) % 256 for at in range(length)]
            values[-1:] = [(start + 201) % 256] if length > 1 else values[-1:]
            kind = moving[(visit + place + turn) % len(moving)]
            yield kind, framed(protocol, identity, length, bytes(values))
    for spec in protocol.instructions:
        steps = list(frames_of(protocol, spec.name))
        bad = frames_of(protocol, FrameClass.BAD_DATA)
        own = (s for s in bad if protocol.headers[s.frame[0]][0] == spec.id)
        marked = [s for s in (*steps, *own) if _is_marked(s)]
        yield from ((kind, step) for kind in kinds for step in marked)
        for number, step in enumerate(steps):
            yield kinds[(number + turn) % len(kinds)], step


def _cut(protocol: Protocol, draw: random.Random) -> Iterator[Step]:
    """Truncated frames of each ID; each group of IDs meets the marked values at each place."""
    lengths = protocol.data_lengths
    longer = cycle(draw.sample(lengths, len(lengths)))
    met: dict[tuple[bool, int], int] = {}
    for identity in protocol.ids:
        for arrived in _ARRIVE:
            if arrived >= lengths[-1]:
                continue
            announced = next(length for length in longer if length > arrived)
            group = identity in protocol.by_id, arrived
            turn = met[group] = met.get(group, draw.randrange(len(MARKED))) + 1
            # Others of the 256 values now and then.
            data = draw.randbytes(arrived) if turn % 3 == 0 else _marked(arrived, turn - turn // 3)
            yield framed(protocol, identity, announced, data)


def _after_cuts(protocol: Protocol, draw: random.Random) -> list[Step]:
    """The frames that follow truncated ones: each marked one of its length, each faulty header."""
    both = (frames_of(protocol, kind) for kind in (FrameClass.VALID, FrameClass.BAD_DATA))
    fitting = list(filter(_is_marked, chain.from_iterable(both)))
    faulty = [
        framed(protocol, identity, length, _marked(length, identity + length))
        for identity, length in _faulty_headers(protocol)
    ]
    return [*draw.sample(fitting, len(fitting)), *draw.sample(faulty, len(faulty))]


def _faulty_headers(protocol: Protocol) -> list[tuple[int, int]]:
    """The headers (ID, length) that are faulty whatever their data."""
    own = {(spec.id, spec.length) for spec in protocol.instructions}
    return [header for header in protocol.headers if header not in own]


def _is_marked(step: Step) -> bool:
    """Whether the first data byte has one of the marked values, or there is none."""
    return len(step.frame) == 1 or step.frame[1] in MARKED


def _marked(length: int, turn: int) -> bytes:
    """Data of marked values; in turn each of them stands at each place."""
    return bytes(MARKED[(turn + 3 * place) % len(MARKED)] for place in range(length))


class _Walk:
    """Leads a robot from wherever it is into contexts, in which it moves where it can.

    `inputs` supplies the frames of each kind.
    """

    def __init__(self, protocol: Protocol, draw: random.Random, inputs: Inputs) -> None:
        self.inputs = inputs
        self._protocol = protocol
        self._draw = draw
        self._classes = {name: values for name, values in state_classes(protocol) if values}
        self._motions = moving_motions(protocol)
        self._state: State | None = None

    @property
    def moving(self) -> bool:
        """Whether the robot moves now."""
        return self._state is not None and self._state.moving

    def begin(self) -> None:
        """Begin where the state is not known, the motion apart: the robot stands."""
        self._state = None

    def lead(self, kind: str) -> tuple[Step, ...]:
        """Go to a state in which it moves, if it stands or by chance, and on to a frame of a kind.

        Returns the frames; the last is that of the kind.
        """
        draw, protocol, car = self._draw, self._protocol, self._protocol.car
        known, steps = self._state, list[Step]()
        state = known or protocol.power_on
        if known is None or not state.moving or draw.random() < _SETS_ALL:
            wanted = state.but(**{car.by: draw.choice(self._motions or [car.still])})
            if known is None or not car.drive(state).speed or draw.random() < _SETS_ALL:
                wanted = wanted.but(**self._any_settings())
            # Steering while it rotates may make a curve of it (R-steer-rotating).
            if car.rotates(car.drive(state).motion):
                steps.append(self.took(step_of(protocol, bytes([protocol.pad_byte]))))
            steps += map(self.took, steps_to(protocol, wanted, known))
        return (*steps, self.took(self.inputs.next(kind)))

    def took(self, step: Step) -> Step:
        """Go on past a step, and return it."""
        before = self._state or self._protocol.power_on
        self._state = state_after(self._protocol, before, step)
        return step

    def _any_settings(self) -> dict[str, Any]:
        """A speed, a steering and a light, each of any of its classes; it moves if it can."""
        found: dict[str, Any] = {}
        for name, values in self._classes.items():
            if name != self._protocol.car.by:
                speed = name == self._protocol.car.speed
                moving = [v for v in values if not speed or len(v) > 1 or v[0] != 0]
                found[name] = self._draw.choice(self._draw.choice(moving or values))
        return found
