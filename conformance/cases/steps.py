"""Test steps: single frames with their bytes, accepted answers and effects.

`step_of` states the rule of each class of frames (table 1, table 2, the safety rule) and the other
readings that the document leaves open; it never calls `spec.codec.judge`. `frames_of` is the one
list of frames by class, `Inputs` a seeded supply of them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from itertools import cycle

from bilprov.conformance.oracle.profile import verdict_of
from bilprov.conformance.oracle.state_model import FAULT, FrameEffect
from bilprov.conformance.oracle.verdicts import Accepted
from bilprov.spec.by_effect import movers
from bilprov.spec.codec import all_data, bad_data, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.readings import POINTS, other_answers


class FrameClass(StrEnum):
    """The classes of frames; the id of a case of single frames begins with it."""

    VALID = "valid"
    UNUSED_ID = "unused-id"
    WRONG_LENGTH = "wrong-length"
    BAD_DATA = "bad-data"
    TRUNCATED = "truncated"
    RECOVERY = "recovery"


@dataclass(frozen=True, slots=True)
class Step:
    """One frame: its bytes, class, accepted answers (the expected first) and effect.

    `point` is the open point that decides between the answers, `reading` the one that the frame is
    about; `clause` is where its rule stands. Of a `truncated` frame some bytes never come.
    """

    frame: bytes
    kind: FrameClass
    accepted: tuple[Accepted, ...]
    frame_effect: FrameEffect
    clause: str
    point: str = ""
    reading: str = ""
    truncated: bool = False

    @property
    def faulty(self) -> bool:
        """Whether the frame is a faulty instruction, which stops the robot."""
        return self.frame_effect.effect is None


TOO_MANY, TOO_FEW = "too-many", "too-few"
"""The kinds of frames with a wrong length."""
FAULTS = (FrameClass.UNUSED_ID, TOO_MANY, TOO_FEW, FrameClass.TRUNCATED, FrameClass.BAD_DATA)
"""The kinds of faulty frames. A valid frame's kind is its instruction's name."""


def code_of(protocol: Protocol, outcome: Outcome) -> int:
    """The response code of an outcome."""
    return protocol.answers[outcome].code


@lru_cache(maxsize=1 << 6)
def _others(protocol: Protocol, point: str) -> tuple[Accepted, ...]:
    """The answers that other choices of an open point allow; none for "", no point."""
    return tuple(
        Accepted(() if code is None else (code,), verdict_of(point, word), reading, word)
        for code, reading, word in (other_answers(protocol, point) if point else ())
    )


def framed(protocol: Protocol, identity: int, length: int, data: bytes) -> Step:
    """The frame of a header and its data, of which fewer than `length` bytes may come."""
    return step_of(protocol, raw_frame(protocol, identity, length, data))


@lru_cache(maxsize=1 << 15)
def step_of(protocol: Protocol, frame: bytes) -> Step:
    """A frame as a step of whatever class it is; one shorter than it announces is truncated."""
    identity, length = protocol.headers[frame[0]]
    spec, data = protocol.by_id.get(identity), frame[1:]
    if len(data) < length:
        cut, outcome = "R-truncated-unused", Outcome.UNKNOWN_ID
        if spec:
            cut = "R-truncated-long" if length > spec.length else "R-truncated-known"
            outcome = Outcome.TOO_FEW
        return _faulty(protocol, frame, FrameClass.TRUNCATED, outcome, cut)
    if spec is None:
        point = "R-unused-length" if length else ""
        return _faulty(protocol, frame, FrameClass.UNUSED_ID, Outcome.UNKNOWN_ID, point)
    if length != spec.length:
        outcome = Outcome.TOO_MANY if length > spec.length else Outcome.TOO_FEW
        # Data out of range *and* too many: judging the data first is a legal other reading.
        point = "" if length < spec.length or spec.in_range(data) else "R-competing-errors"
        reading = point or "R-known-length"
        return _faulty(protocol, frame, FrameClass.WRONG_LENGTH, outcome, point, reading)
    if not spec.in_range(data):
        reading = next((f.reading for f in spec.fields if f.reading), "")
        point = reading if reading in POINTS else ""
        return _faulty(protocol, frame, FrameClass.BAD_DATA, Outcome.BAD_DATA, point, reading)
    accepted = (Accepted((code_of(protocol, Outcome.VALID),)),)
    effect = FrameEffect(spec.effect, spec.decode(data))
    return Step(frame, FrameClass.VALID, accepted, effect, protocol.clauses.instructions)


def _faulty(
    protocol: Protocol,
    frame: bytes,
    kind: FrameClass,
    outcome: Outcome,
    point: str,
    reading: str = "",
) -> Step:
    """A faulty frame: the answer of its outcome, and those of other choices of the point."""
    other = (Accepted((code_of(protocol, outcome),)), *_others(protocol, point))
    of_responses = outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW)
    clause = protocol.clauses.responses if of_responses else protocol.clauses.instructions
    cut = kind is FrameClass.TRUNCATED
    return Step(frame, kind, other, FAULT, clause, point, reading or point, truncated=cut)


@lru_cache(maxsize=1 << 6)
def headers_of(protocol: Protocol, kind: str) -> tuple[tuple[int, int, int], ...]:
    """The headers that make a frame one of this class of faults, whatever its data.

    Each is an ID, the number of data bytes that it announces and how many of them come.
    """
    lengths, specs = protocol.data_lengths, protocol.instructions
    if kind == FrameClass.UNUSED_ID:
        return tuple((identity, n, n) for identity in protocol.unused_ids for n in lengths)
    if kind == FrameClass.TRUNCATED:
        return tuple((identity, n, come) for identity, n in protocol.headers for come in range(n))
    wrong = ((s, n) for s in specs for n in lengths if n != s.length)
    many = {FrameClass.WRONG_LENGTH: (True, False), TOO_MANY: (True,), TOO_FEW: (False,)}
    return tuple((s.id, n, n) for s, n in wrong if (n > s.length) in many[kind])


def frames_of(
    protocol: Protocol, kind: str, fill: Callable[[int], bytes] | None = None
) -> Iterator[Step]:
    """Every frame of a kind: of an instruction by its name, of any, or of a class of faults.

    Where the data do not count, `fill` gives that many bytes of them, Stop bytes without it. Wide
    fields are sampled, see `spec.codec`.
    """
    specs = [protocol.by_name[kind]] if kind in protocol.by_name else protocol.instructions
    if kind in (FrameClass.VALID, *protocol.by_name):
        yield from (framed(protocol, s.id, s.length, data) for s in specs for data in all_data(s))
    elif kind == FrameClass.BAD_DATA:
        yield from (framed(protocol, s.id, s.length, data) for s in specs for data in bad_data(s))
    else:
        for identity, length, come in headers_of(protocol, kind):
            data = fill(come) if fill else bytes([protocol.pad_byte]) * come
            yield framed(protocol, identity, length, data)


def kind_of(protocol: Protocol, step: Step) -> str:
    """The kind that a step counts as: its instruction's name, or the class of its fault.

    A wrong length is `too-many` or `too-few`.
    """
    identity, length = protocol.headers[step.frame[0]]
    spec = protocol.by_id.get(identity)
    if not step.faulty and spec is not None:
        return spec.name
    if step.truncated:
        return FrameClass.TRUNCATED
    if spec is None:
        return FrameClass.UNUSED_ID
    if length == spec.length:
        return FrameClass.BAD_DATA
    return TOO_MANY if length > spec.length else TOO_FEW


def one_of_each(protocol: Protocol) -> dict[str, Step]:
    """A faulty frame of each class that the protocol has, by its kind.

    The truncated one, and that with too few data, are of an instruction with data.
    """
    carrying = next((s for s in protocol.instructions if s.length), None)
    found = {kind: next(frames_of(protocol, kind), None) for kind in FAULTS}
    if carrying is None:
        del found[FrameClass.TRUNCATED]
    else:
        found[FrameClass.TRUNCATED] = framed(protocol, carrying.id, carrying.length, b"")
    return {kind: step for kind, step in found.items() if step}


def open_frames(protocol: Protocol) -> dict[str, Step]:
    """A frame for each open point about the answer to a single frame, by the point's id."""
    fill = bytes([protocol.pad_byte])
    steps: list[Step] = []
    longest = protocol.data_lengths[-1]
    if protocol.unused_ids:
        length = min(2, longest)
        steps.append(framed(protocol, protocol.unused_ids[0], length, fill * length))
    bad = frames_of(protocol, FrameClass.BAD_DATA)
    for frame in (one.frame for one in bad if len(one.frame) <= longest):
        identity, length = protocol.headers[frame[0]]
        steps.append(framed(protocol, identity, length + 1, frame[1:] + fill))
        break
    carrying = next((s for s in protocol.instructions if s.length), None)
    if carrying:
        lengths = range(carrying.length, min(carrying.length + 1, longest) + 1)
        steps += (framed(protocol, carrying.id, length, b"") for length in lengths)
    if protocol.unused_ids:
        steps.append(framed(protocol, protocol.unused_ids[0], 1, b""))
    return {step.point: step for step in steps}


# -- a supply of frames by kind: the data of each rotate through all their values -----------------
# A kind is an instruction's name, or a class of faulty frame. The next frame of a kind takes the
# next of its values, so that each value is sent between ever other neighbours.


FILLS = 3
"""Number of ways to fill faulty frames: Stop bytes, a motion (seen if it is run), all bits set."""

_STEP = 83  # from one byte of a fill to the next: odd, and far from the values at its neighbours


class Inputs:
    """A seeded supply of frames.

    `kinds` are the kinds that this protocol has, without truncated frames; `next` supplies those
    too.
    """

    def __init__(self, protocol: Protocol, seed: int) -> None:
        self._draw = random.Random(f"inputs {seed}")
        self._protocol = protocol
        self._turn = 0
        self._supplies: dict[str, Iterator[Step]] = {}
        for spec in protocol.instructions:
            self._supplies[spec.name] = self._valid(spec)
        for kind in (FrameClass.UNUSED_ID, TOO_MANY, TOO_FEW):
            if headers_of(protocol, kind):
                self._supplies[kind] = self._whole(headers_of(protocol, kind))
        bad = list(frames_of(protocol, FrameClass.BAD_DATA))
        if bad:
            self._supplies[FrameClass.BAD_DATA] = cycle(self._draw.sample(bad, len(bad)))
        self.kinds = tuple(self._supplies)
        cuts = list(frames_of(protocol, FrameClass.TRUNCATED, self.fill))
        self._supplies[FrameClass.TRUNCATED] = cycle(self._draw.sample(cuts, len(cuts)))
        self.valid_kinds = tuple(spec.name for spec in protocol.instructions)
        self.faulty_kinds = tuple(k for k in self.kinds if k not in self.valid_kinds)
        self.movers = tuple(s.name for s in movers(protocol))
        self.settings = tuple(
            s.name for s in protocol.instructions if not s.effect.sets(protocol.car.by)
        )

    def next(self, kind: str) -> Step:
        """The next frame of a kind."""
        return next(self._supplies[kind])

    def fill(self, length: int) -> bytes:
        """`length` data bytes for a faulty frame; each call takes the next way to fill them.

        One way takes the next values, so that every value comes to stand at every place.
        """
        self._turn += 1
        way, turn = self._turn % (FILLS + 1), self._turn // (FILLS + 1)
        if way < FILLS:
            return fill(self._protocol, length, way)
        return bytes((turn + _STEP * place) % 256 for place in range(length))

    def _valid(self, spec: InstructionSpec) -> Iterator[Step]:
        steps = list(frames_of(self._protocol, spec.name))
        limits = {f.name: (f.low, f.high) for f in spec.fields}
        ends = [
            step
            for step in steps
            if all(value in limits[name] for name, value in step.frame_effect.values.items())
        ]
        # The ends of a range come more often than the rest: counters and signs turn over there.
        while True:
            for index, step in enumerate(self._draw.sample(steps, len(steps))):
                yield step
                if index % 6 == 5 and len(steps) > 2 * len(ends):
                    yield self._draw.choice(ends)

    def _whole(self, headers: Sequence[tuple[int, int, int]]) -> Iterator[Step]:
        while True:
            for identity, length, _ in self._draw.sample(headers, len(headers)):
                yield framed(self._protocol, identity, length, self.fill(length))


def fill(protocol: Protocol, length: int, turn: int) -> bytes:
    """Data of a faulty frame: Stop bytes, a motion that is seen if it is run, or all bits set."""
    mover = next(iter(movers(protocol)), protocol.stop)
    fills = (protocol.pad_byte, protocol.header_bytes[mover.id, mover.length], 0xFF)
    return bytes([fills[turn % FILLS]]) * length
