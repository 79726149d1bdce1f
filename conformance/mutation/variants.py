"""Legal variants: devices that follow another reading of the document than the reference.

They are made from the open points (`spec.readings`) and from `variants.toml`. A variant never
fails. A mixture (`mixtures.py`), which shows two choices of one point, does.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import msgspec

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.faults import Row, filled, hooks, table
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, Behaviour

FAMILY = "variant"
MIXTURE = "mixture:"


class VariantRow(Row, frozen=True, forbid_unknown_fields=True):
    """A variant as data; `chooses` are the words of choices by open point, `=` between them."""

    chooses: str = ""
    allow: str = ""
    mixes: bool = False


@dataclass(frozen=True)
class Variant:
    """A legal variant: a choice other than the default at one reading.

    `name` is the reading's id, `=` and the choice. `allow` names the option (`--allow`) without
    which the choice fails, "" if it is legal without one. `mixes` is true for a choice that a
    device must make the same way each time, so that mixtures of it are faults.
    """

    protocol: Protocol
    name: str
    row: VariantRow

    @property
    def doc(self) -> str:
        """What the device does."""
        return self.row.doc

    @property
    def allow(self) -> str:
        """The option that it needs."""
        return self.row.allow

    @property
    def mixes(self) -> bool:
        """Whether to mix it with the default is a fault."""
        return self.row.mixes or bool(self.row.chooses)

    @property
    def reading(self) -> str:
        """The reading's id."""
        return self.name.split("=")[0]

    @property
    def words(self) -> tuple[tuple[str, str], ...]:
        """The pairs of open point and choice from which it is made, if it is made from such."""
        pairs = (pair.split("=") for pair in self.row.chooses.split())
        return tuple((point.replace(":", " "), word) for point, word in pairs)

    @cached_property
    def fault(self) -> Fault:
        """The fault that makes a simulator take this choice each time."""
        return self.taking("", self.name, self.doc)

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
