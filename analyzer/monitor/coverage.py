"""Counts which parts of the document ordinary traffic has exercised, out of how many, by clause."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import State

_KEPT = 1 << 16  # frames remembered of each kind: a limit for the memory of long, varied sessions
_COUNTED = 1 << 16  # different data, up to which it makes sense to say how many of them were met


class Covered(msgspec.Struct, frozen=True):
    """One coverage count: the clause, what is counted, how many were met (`done`) out of `of`."""

    clause: str
    what: str
    done: int
    of: int


class Coverage:
    """Counts the frames and responses that were exercised. Repeated frames cost almost nothing."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._valid: dict[int, set[bytes]] = {spec.id: set() for spec in protocol.instructions}
        self._headers: set[int] = set()
        self._bad_data: set[bytes] = set()
        self._cuts: set[bytes] = set()
        self._unused: set[int] = set()
        self._wrong: set[int] = set()
        self._wheels = protocol.wheels
        self._moving: set[tuple[Outcome | None, str]] = set()
        self._names: set[str] = set()

    def frame(self, judgement: Judgement, state: State) -> None:
        """Count a frame; `state` is the predicted state of the device before the frame."""
        motion = getattr(state, self._wheels.by) if self._wheels else ""
        frame = judgement.frame
        if judgement.valid:
            met, tail = self._valid[judgement.id], self._protocol.layout.tail
            data = frame[judgement.head : len(frame) - tail]
            if data not in met and len(met) < _KEPT:
                met.add(data)
                self._headers.add(frame[0])
            return
        self._headers.add(frame[0])
        if judgement.truncated:
            # A truncated frame is counted by its header and length; its data do not matter.
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

    def answer(self, record: DeviceRecord) -> None:
        """Count the names of an answer's codes."""
        self._names.update(record.reply.names if record.reply else {record.name or ""})

    def covered(self) -> Iterator[Covered]:
        """Every count, in the order of the document's clauses.

        Where frames have other parts besides the header and data, only those of what is said.
        """
        if self._protocol.plain:
            yield from self._of_headers()
            return
        yield self._instructions()
        for spec in self._protocol.instructions:
            if 1 < spec.valid_count <= _COUNTED:
                yield self._data(spec)
        if self._protocol.codes:
            yield self._answers()

    def _instructions(self) -> Covered:
        met = sum(1 for frames in self._valid.values() if frames)
        clause = self._protocol.clauses.instructions
        return Covered(clause, "instructions", met, len(self._protocol.instructions))

    def _data(self, spec: InstructionSpec) -> Covered:
        clause, met = self._protocol.clauses.instructions, len(self._valid[spec.id])
        return Covered(clause, f"data of {spec.name}", met, spec.valid_count)

    def _answers(self) -> Covered:
        protocol = self._protocol
        met = len(self._names & {code.name for code in protocol.responses})
        return Covered(protocol.clauses.responses, "response codes", met, len(protocol.codes))

    def _of_headers(self) -> Iterator[Covered]:
        protocol, clauses = self._protocol, self._protocol.clauses
        specs = protocol.instructions
        yield Covered(clauses.header, "headers", len(self._headers), len(protocol.headers))
        yield self._instructions()
        of = sum(spec.valid_count for spec in specs)
        done = sum(len(frames) for frames in self._valid.values())
        yield Covered(clauses.instructions, "valid frames", done, of)
        yield from (self._data(spec) for spec in specs if spec.fields)
        unused = len(protocol.unused_ids) * len(protocol.data_lengths)
        yield Covered(clauses.instructions, "headers with an unused ID", len(self._unused), unused)
        bad = sum(spec.bad_data_count for spec in specs)
        yield Covered(clauses.instructions, "data out of range", len(self._bad_data), bad)
        wrong = len(specs) * (len(protocol.data_lengths) - 1)
        yield Covered(clauses.responses, "headers with a wrong length", len(self._wrong), wrong)
        cuts = sum(protocol.lengths)
        yield Covered(clauses.responses, "frames cut short", len(self._cuts), cuts)
        yield self._answers()
        if self._wheels:
            turns = self._wheels.turns
            yield Covered(
                clauses.safety,
                "classes of fault x kinds of motion",
                len({key for key in self._moving if key[1] in turns}),
                self._classes() * len(turns),
            )

    def _classes(self) -> int:
        """How many classes of faulty frame the protocol has; truncated is one of them."""
        protocol = self._protocol
        found: set[Outcome | None] = {None} if any(protocol.lengths) else set()
        if protocol.unused_ids:
            found.add(Outcome.UNKNOWN_ID)
        for spec in protocol.instructions:
            if any(length > spec.length for length in protocol.data_lengths):
                found.add(Outcome.TOO_MANY)
            if spec.length:
                found.add(Outcome.TOO_FEW)
            if spec.bad_data_count:
                found.add(Outcome.BAD_DATA)
        return len(found)
