"""What a simulated device remembers of what was written to it, so that it is read back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Memory
from bilprov.spec.protocol import InstructionSpec, Protocol


class Cells:
    """The cells of one device; one that was never written has its value at power-on."""

    def __init__(self, protocol: Protocol) -> None:
        self._power_on = {
            memory.name: memory.power_on
            for spec in protocol.instructions
            for memory in (spec.writes, spec.reads)
            if memory and memory.power_on
        }
        self._cells: dict[tuple[str, Any], dict[int, int]] = {}
        self._latest: dict[str, Any] = {}  # the value of each field in the latest request with one
        # What is written by the next instruction of that name.
        self._waiting: dict[str, tuple[Memory, Mapping[str, Any]]] = {}

    def take(self, spec: InstructionSpec, fields: Mapping[str, Any]) -> None:
        """Do what a valid request asks for."""
        self._latest |= fields
        if spec.name in self._waiting:
            self._write(*self._waiting.pop(spec.name))
        if spec.writes and spec.writes.until:
            self._waiting[spec.writes.until] = spec.writes, fields
        elif spec.writes:
            self._write(spec.writes, fields)

    def read(self, memory: Memory, fields: Mapping[str, Any], told: FieldSpec) -> Any:
        """The value of the field `told` of the answer, in which a request's cells are."""
        first, cells = self._place(memory, fields)
        fixed = told.many.fixed if told.many else 1
        count = fields[memory.count] if memory.count else fixed
        values = [cells.get(place, 0) for place in range(first, first + count)]
        if told.many is None:
            return values[0]
        if memory.bits:
            values = _packed(values)
        return bytes(values) if told.many.element is None else tuple(values)

    def _write(self, memory: Memory, fields: Mapping[str, Any]) -> None:
        first, cells = self._place(memory, fields)
        keep = fields[memory.keep] if memory.keep else 0
        for at, value in enumerate(_as_cells(memory, fields), first):
            cells[at] = cells.get(at, 0) & keep | value & ~keep

    def _place(self, memory: Memory, fields: Mapping[str, Any]) -> tuple[int, dict[int, int]]:
        """The number of the first cell that is meant, and the cells that it is one of."""
        first = memory.cell(fields.get(memory.at, self._latest.get(memory.at, 0)))
        of = fields[memory.of] if memory.of else None
        known = dict(self._power_on.get(memory.name, {}))
        return first, self._cells.setdefault((memory.name, of), known)


def blocks(memory: Memory, fields: Mapping[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    """The addresses in a request with blocks, and what the request holds for the device there."""
    value, size = fields[memory.value], 1 + fields[memory.count]
    for at in range(0, len(value), size):
        yield value[at], {**fields, memory.value: value[at + 1 : at + size]}


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
