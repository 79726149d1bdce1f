"""Which parts of the document ordinary driving has shown, out of how many there are, by clause."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod

import msgspec

from spec.codec import Judgement
from spec.fields import Outcome
from spec.motion import Motion
from spec.protocol import InstructionSpec, Protocol

_KEPT = 1 << 16  # frames remembered of each kind, so that hours of wide data do not fill the memory


class Covered(msgspec.Struct, frozen=True):
    """One count: the clause, what of it, how many were met (`done`) and there are (`of`)."""

    clause: str
    what: str
    done: int
    of: int


class Coverage:
    """Adds up what was exercised. Frames that were met before cost next to nothing."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._valid: dict[int, set[bytes]] = {spec.id: set() for spec in protocol.instructions}
        self._headers: set[int] = set()
        self._bad_data: set[bytes] = set()
        self._cuts: set[bytes] = set()
        self._unused: set[int] = set()
        self._wrong: set[int] = set()
        self._moving: set[tuple[Outcome | None, str]] = set()
        self._codes: set[int] = set()

    def frame(self, judgement: Judgement, motion: str) -> None:
        """Count a frame; `motion` is what the robot was predicted to do when it came."""
        frame = judgement.frame
        if judgement.valid:
            met = self._valid[judgement.id]
            if frame not in met and len(met) < _KEPT:
                met.add(frame)
                self._headers.add(frame[0])
            return
        self._headers.add(frame[0])
        if judgement.truncated:
            # What matters is the header and how much arrived, not which data.
            self._cuts.add(bytes((frame[0], len(frame))))
            self._moving.add((None, motion))
            return
        self._moving.add((judgement.outcome, motion))
        if judgement.outcome is Outcome.UNKNOWN_ID:
            self._unused.add(frame[0])
        elif judgement.outcome is not Outcome.BAD_DATA:
            self._wrong.add(frame[0])
        elif len(self._bad_data) < _KEPT:
            self._bad_data.add(frame)

    def answer(self, byte: int) -> None:
        """Count a response code."""
        self._codes.add(byte)

    def covered(self) -> Iterator[Covered]:
        """Every count, in the order of the document's clauses."""
        protocol, clauses = self._protocol, self._protocol.clauses
        specs = protocol.instructions
        yield Covered(clauses.header, "headers", len(self._headers), len(protocol.headers))
        met = sum(1 for frames in self._valid.values() if frames)
        yield Covered(clauses.instructions, "instructions", met, len(specs))
        of = sum(_frames(spec) for spec in specs)
        done = sum(len(frames) for frames in self._valid.values())
        yield Covered(clauses.instructions, "valid frames", done, of)
        for spec in specs:
            if spec.fields:
                what = f"data of {spec.name}"
                yield Covered(clauses.instructions, what, len(self._valid[spec.id]), _frames(spec))
        unused = len(protocol.unused_ids) * len(protocol.data_lengths)
        yield Covered(clauses.instructions, "headers with an unused ID", len(self._unused), unused)
        bad = sum(256**spec.length - _frames(spec) for spec in specs)
        yield Covered(clauses.instructions, "data out of range", len(self._bad_data), bad)
        wrong = len(specs) * (len(protocol.data_lengths) - 1)
        yield Covered(clauses.responses, "headers with a wrong length", len(self._wrong), wrong)
        cuts = sum(protocol.lengths)
        yield Covered(clauses.responses, "frames cut short", len(self._cuts), cuts)
        codes = len(self._codes & set(protocol.codes))
        yield Covered(clauses.responses, "response codes", codes, len(protocol.codes))
        yield Covered(
            clauses.safety,
            "classes of fault x kinds of motion",
            len({key for key in self._moving if key[1] != Motion.STOPPED}),
            self._classes() * len([m for m in Motion if m is not Motion.STOPPED]),
        )

    def _classes(self) -> int:
        """How many classes of fault the protocol has; to be cut short is one."""
        protocol = self._protocol
        found: set[Outcome | None] = {None} if any(protocol.lengths) else set()
        if protocol.unused_ids:
            found.add(Outcome.UNKNOWN_ID)
        for spec in protocol.instructions:
            if any(length > spec.length for length in protocol.data_lengths):
                found.add(Outcome.TOO_MANY)
            if spec.length:
                found.add(Outcome.TOO_FEW)
            if 256**spec.length > _frames(spec):
                found.add(Outcome.BAD_DATA)
        return len(found)


def _frames(spec: InstructionSpec) -> int:
    """How many valid frames an instruction has."""
    return prod(part.high - part.low + 1 for part in spec.fields)
