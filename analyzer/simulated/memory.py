"""What a simulated device remembers of what was written to it, so that it is read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Memory


class Cells:
    """The cells of one device; one that was never written is 0."""

    def __init__(self) -> None:
        self._cells: dict[tuple[str, Any], dict[int, int]] = {}
        self._latest: dict[str, Any] = {}  # the value of each field in the latest request with one

    def copy(self) -> Cells:
        """Other cells with the same values."""
        other = Cells()
        other._cells = {place: dict(cells) for place, cells in self._cells.items()}
        other._latest = dict(self._latest)
        return other

    def note(self, fields: Mapping[str, Any]) -> None:
        """Take note of the fields of a valid request."""
        self._latest |= fields

    def write(self, memory: Memory, fields: Mapping[str, Any]) -> None:
        """Write what a request holds."""
        first, cells = self._place(memory, fields)
        cells.update(enumerate(_as_cells(memory, fields), first))

    def read(self, memory: Memory, fields: Mapping[str, Any], told: FieldSpec) -> Any:
        """The value of the field `told` of the answer, in which a request's cells are."""
        first, cells = self._place(memory, fields)
        count = fields[memory.count] if memory.count else 1
        values = [cells.get(place, 0) for place in range(first, first + count)]
        if told.many is None:
            return values[0]
        if memory.bits:
            values = _packed(values)
        return bytes(values) if told.many.element is None else tuple(values)

    def _place(self, memory: Memory, fields: Mapping[str, Any]) -> tuple[int, dict[int, int]]:
        """The number of the first cell that is meant, and the cells that it is one of."""
        first = fields.get(memory.at, self._latest.get(memory.at, 0)) * memory.factor
        of = fields[memory.of] if memory.of else None
        return first, self._cells.setdefault((memory.name, of), {})


def _as_cells(memory: Memory, fields: Mapping[str, Any]) -> list[int]:
    """The values of the cells that a request writes."""
    value = fields[memory.value]
    if isinstance(value, int):
        return [int(value != 0) if memory.bits else value]
    values = [byte >> bit & 1 for byte in value for bit in range(8)] if memory.bits else [*value]
    return values[: fields.get(memory.count, len(values))]


def _packed(bits: list[int]) -> list[int]:
    """Bits as bytes, the first bit of each in bit 0."""
    groups = (bits[at : at + 8] for at in range(0, len(bits), 8))
    return [sum(bit << place for place, bit in enumerate(group)) for group in groups]
