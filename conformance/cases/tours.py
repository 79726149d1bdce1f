"""Tours: sequences that cover the model; each frame is chosen to cover the most that is new.

What is covered are tuples of what came before (the last two kinds, motion, speed, steering, LED)
and the frame's kind. Part of the frames is drawn at random, from a seed, so that a tour is also a
random test. The data rotate through all their values by themselves (`frame_source`).
"""

from __future__ import annotations

import random
from dataclasses import dataclass

from bilprov.conformance.cases.case import in_motion, state_after, steps_to
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import FrameClass, Inputs, Step
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

_LENGTH = 40  # bursts of a sequence
CUT = FrameClass.TRUNCATED
_RANDOM = 0.35  # share of the frames that are drawn without regard to what was covered


@dataclass
class _Where:
    """The position in a tour: the model's state, and the last two kinds of frames."""

    state: State
    last: str = ""
    before: str = ""


class Tours:
    """An endless supply of sequences that cover the model; it remembers what was covered."""

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self._protocol = protocol
        self._draw = random.Random(f"tours {seed}")
        self._inputs = Inputs(protocol, seed)
        self._met: dict[tuple[object, ...], set[str]] = {}  # the kinds met in each context
        self._fast = protocol.speeds[1]

    def waited(self, name: str, number: int, bursts: int = _LENGTH, cuts: int = 1) -> SequenceCase:
        """A sequence that waits for each frame's answer; `cuts` of the frames are truncated."""
        setup, where = self._begin()
        places = set(self._draw.sample(range(bursts), min(cuts, bursts)))
        made = [
            Burst((self._go(where, CUT) if index in places else self._next(where),))
            for index in range(bursts)
        ]
        return self._sequence(f"sequence/{name}/{number:03}", setup, made)

    def pipelined(
        self, name: str, number: int, bursts: int, sizes: tuple[int, int], *, cut: bool
    ) -> SequenceCase:
        """A sequence of `bursts`, each of `sizes` (least, most) frames sent in one go.

        With `cut` the last frame of one of them is truncated.
        """
        setup, where = self._begin()
        made = []
        last = self._draw.randrange(bursts)
        for index in range(bursts):
            steps = [self._next(where) for _ in range(self._draw.randint(*sizes))]
            if index == last and cut:
                steps[-1] = self._go(where, CUT)
            made.append(Burst(tuple(steps)))
        return self._sequence(f"pipelined/{name}/{number:03}", setup, made)

    def split(self, name: str, number: int, bursts: int) -> SequenceCase:
        """A sequence of frames that come in pieces, with pauses well below the time-out."""
        setup, where = self._begin()
        made: list[Burst] = []
        while len(made) < bursts:
            steps = tuple(self._next(where) for _ in range(self._draw.choice((1, 1, 2, 3))))
            size = sum(len(step.frame) for step in steps)
            if size < 2:
                made.append(Burst(steps))
                continue
            # Four pauses at most: they do not reach a time-out over the whole frame either.
            most = min(4, size - 1)
            every = range(1, most + 1)
            some = sorted(self._draw.sample(range(1, size), self._draw.randint(1, min(2, most))))
            where_to = (1,) if self._draw.random() < 0.4 else tuple(some)
            made.append(Burst(steps, tuple(every) if self._draw.random() < 0.2 else where_to))
        return self._sequence(f"split/{name}/{number:03}", setup, made)

    def _sequence(self, ident: str, setup: tuple[Step, ...], bursts: list[Burst]) -> SequenceCase:
        requirement = "each frame is carried out and answered, whatever came before it"
        return SequenceCase.of(self._protocol, ident, requirement, bursts, setup=setup)

    def _begin(self) -> tuple[tuple[Step, ...], _Where]:
        """A preamble that sets the whole state and makes the robot drive, and where it leads."""
        protocol, car, draw = self._protocol, self._protocol.car, self._draw
        movers = [s for s in protocol.instructions if s.name in self._inputs.movers]
        motion = draw.choice([m for s in movers if (m := car.motion(s.effect))] or [car.still])
        speed = draw.randint(self._fast // 2, self._fast)
        lights = {n: draw.randint(*protocol.limits.get(n, (0, 0))) for n in protocol.lights}
        state = in_motion(protocol, motion, speed, lights)
        return steps_to(protocol, state), _Where(state)

    def _next(self, where: _Where) -> Step:
        return self._go(where, self._kind(where))

    def _go(self, where: _Where, kind: str) -> Step:
        """The next frame of that kind; the position moves on past it."""
        step = self._inputs.next(kind)
        for met in self._kinds_met(where):
            met.add(kind)
        where.state = state_after(self._protocol, where.state, step)
        where.before, where.last = where.last, kind
        return step

    def _kind(self, where: _Where) -> str:
        inputs, draw = self._inputs, self._draw
        if not where.state.moving and draw.random() < 0.5:
            # Standing still hides most faults.
            by_name = self._protocol.by_name
            car = self._protocol.car
            speeds = [k for k in inputs.settings if by_name[k].effect.sets(car.speed)]
            if not car.drive(where.state).speed and speeds:
                return draw.choice(speeds)
            if inputs.movers:
                return draw.choice(inputs.movers)
        if draw.random() < _RANDOM:
            return draw.choice(inputs.kinds)
        best, most = inputs.kinds[0], -1.0
        contexts = self._kinds_met(where)
        for kind in inputs.kinds:
            gain = draw.random() + len([met for met in contexts if kind not in met])
            if gain > most:
                best, most = kind, gain
        return best

    def _kinds_met(self, where: _Where) -> list[set[str]]:
        """The kinds of frames met so far in each context of this position."""
        motion, speed, steering = self._protocol.car.drive(where.state)
        side = (steering > 0) - (steering < 0)
        lights = tuple(getattr(where.state, name) for name in self._protocol.lights)
        contexts = (
            (0, motion, where.state.moving),
            (1, where.last),
            (2, where.last, motion),
            (3, side, motion),
            (4, lights),
            (5, where.last, where.before),
            (6, lights, motion),
            (7, 2 * speed > self._fast, side),
        )
        return [self._met.setdefault(context, set()) for context in contexts]
