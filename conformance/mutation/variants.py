"""Legal variants: devices that follow another reading of the document than the reference.

They are made from the open points (`spec.readings`) and from `variants.toml`. A variant never
fails. A mixture does: a faulty device that follows one reading for some frames and another for the
others. Only mixtures that can show both choices are made: one by ID, for example, needs two IDs at
which the point arises.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Any

import msgspec

from bilprov.conformance.dut.simulator import Event, Fault
from bilprov.conformance.mutation.faults import Row, filled, hooks, table
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, Behaviour

FAMILY = "variant"
MIXTURE = "mixture:"


class VariantRow(Row, frozen=True, forbid_unknown_fields=True):
    """A variant as data; `chooses` are the words of choices by open point, `=` between them.

    `allow` names the option (`--allow`) without which the choice fails, "" if it is legal without
    one. `mixes` is true for a choice that a device must make the same way each time, as it must
    those of `chooses`: mixtures of it are faults.
    """

    chooses: str = ""
    allow: str = ""
    mixes: bool = False


@dataclass(frozen=True)
class Variant:
    """A legal variant: a choice other than the default at one reading.

    `name` is the reading's id, `=` and the choice.
    """

    protocol: Protocol
    name: str
    row: VariantRow

    @property
    def words(self) -> tuple[tuple[str, str], ...]:
        """The pairs of open point and choice from which it is made, if it is made from such."""
        pairs = (pair.split("=") for pair in self.row.chooses.split())
        return tuple((point.replace(":", " "), word) for point, word in pairs)

    @cached_property
    def fault(self) -> Fault:
        """The fault that makes a simulator take this choice each time."""
        return self.taking("", self.name, self.row.doc)

    def taking(self, when: str, name: str, doc: str) -> Fault:
        """Return the fault that takes this choice at frames of this trigger."""
        row = self.row
        if row.chooses:
            points = " ".join(pair.split("=")[0] for pair in row.chooses.split())
            what = ";".join(f"chooses {pair.replace('=', ' ')}" for pair in row.chooses.split())
            row = msgspec.structs.replace(row, when=f"open {points}", what=what)
        row = msgspec.structs.replace(row, when=f"{row.when}, {when}")
        return Fault(name, FAMILY, doc, exit=0, **hooks(self.protocol, row))


@cache
def variants(protocol: Protocol) -> dict[str, Variant]:
    """Return every legal variant by name: those of the table, then the choices left."""
    rows = table("variants.toml", dict[str, VariantRow])
    placed = [Variant(protocol, name, row) for name, row in filled(protocol, rows)]
    return {variant.name: variant for variant in (*placed, *_left(protocol, placed))}


def _left(protocol: Protocol, placed: Iterable[Variant]) -> Iterator[Variant]:
    """Yield a variant for each choice about an answer or the state that none of these makes."""
    made = {pair for variant in placed for pair in variant.words}
    for point in POINTS.values():
        for choice in point.choices[1:]:
            simple = choice.does not in (None, Behaviour.DISCARDED) and not choice.option
            if simple and (point.id, choice.word) not in made:
                reading, _, part = point.id.partition(" ")
                chooses = f"{point.id.replace(' ', ':')}={choice.word}"
                row = VariantRow(doc=f"{point.id}: {choice.word}", chooses=chooses)
                yield Variant(protocol, f"{reading}={part and part + '-'}{choice.word}", row)


_TIMES = 12  # how often the point arises before the device changes its choice


@cache
def mixtures(protocol: Protocol) -> dict[str, Fault]:
    """Return every mixture by name."""
    mixed = (v for v in variants(protocol).values() if v.row.mixes or v.row.chooses)
    return {fault.name: fault for variant in mixed for fault in _mixtures_of(protocol, variant)}


def _mixtures_of(protocol: Protocol, variant: Variant) -> Iterator[Fault]:
    """Yield the mixtures of one variant: by frame, by count, by ID and by motion, if both show."""
    ids, motions = _where_it_arises(protocol, variant)
    rows = [
        ("by-frame", "every second time", "times !& 1"),
        (
            f"after-{_TIMES}",
            f"after it has chosen otherwise {_TIMES} times",
            f"times >= {_TIMES}",
        ),
    ]
    if len(ids) > 1:
        some, others = (", ".join(map(str, part)) for part in (ids[::2], ids[1::2]))
        words = f"for ID {some} and not for {others}"
        rows.append(("by-id", words, f"id {some.replace(',', '')}"))
    if len(motions) > 1:
        moves = motions[1::2]
        words = f"while its motion is {' or '.join(moves)}"
        rows.append(("by-motion", words, f"motion {' '.join(moves)}"))
    for name, words, when in rows:
        fault = variant.taking(
            when, f"{MIXTURE}{variant.name}:{name}", f"{variant.row.doc}, but only {words}"
        )
        yield replace(
            fault,
            family="mixture",
            exit=1,
            caught_by=("reading/*",),
            clauses=("header", "instructions", "responses", "safety"),
        )


def _where_it_arises(protocol: Protocol, variant: Variant) -> tuple[list[int], list[str]]:
    """Return the IDs and the motions at which the device can take the choice."""
    acting = variant.fault.trigger
    assert acting is not None
    ids: set[int] = set()
    motions: dict[str, None] = {}
    for motion, event in _moments(protocol):
        if acting.holds(event, {}):
            ids.add(event.judgement.id)
            motions[motion] = None
    return sorted(ids), list(motions)


@cache
def _moments(protocol: Protocol) -> list[tuple[str, Event]]:
    """Each frame in each motion at the highest settings, as a device meets it."""
    top = {name: high for name, (_, high) in protocol.limits.items()}
    judgements = [judge(protocol, frame) for frame in _frames(protocol)]
    by, met = protocol.car.by, []
    for motion in protocol.variables[by].words:
        before = protocol.state(**{by: motion}, **top)
        for judgement in judgements:
            kind = "truncated" if judgement.truncated else "instruction"
            met.append((motion, Event(protocol, judgement, before, 0, 0, kind, 0)))
    return met


def _frames(protocol: Protocol) -> Iterator[bytes]:
    """Yield, for each header, low and high data, and the header alone."""
    for header, length in enumerate(protocol.lengths):
        for fill in (protocol.pad_byte, 0xFF):
            yield bytes([header]) + bytes([fill]) * length
        yield bytes([header])


# What tells of a fault; every other field is a hook or a setting, which a device has once. Only
# reactions can follow one another.
_TOLD = (
    "name",
    "family",
    "doc",
    "caught_by",
    "exit",
    "clauses",
    "needs",
    "what",
    "trigger",
)
_ONCE = tuple(f.name for f in fields(Fault) if f.name not in (*_TOLD, "react"))
_USUAL = Fault("", FAMILY, "", exit=0)


def hooks_of(fault: Fault) -> dict[str, Any]:
    """Return the hooks and settings besides the reaction that differ from the reference."""
    return {n: getattr(fault, n) for n in _ONCE if getattr(fault, n) != getattr(_USUAL, n)}
