"""Classes of a field's bytes: after which beginnings the same kinds of values may still come.

A value counts only by its range and its sign: too low, negative, zero, positive or too high.
"""

from __future__ import annotations

from bilprov.spec.data import FieldSpec


class FieldPrefixes:
    """The beginnings of one field, in classes.

    Each byte of an integer adds its part to the value, whatever the others are, and what the bytes
    still to come can add are evenly spaced numbers. Two beginnings are of one class if equally many
    of these lead to each kind of value.
    """

    def __init__(self, field: FieldSpec) -> None:
        self.size = field.size
        self._bounds = sorted({field.low, 0, 1, field.high + 1})
        zeros = [0] * field.size
        self._base = field.parse(bytes(zeros))
        self._parts = [
            [
                field.parse(bytes([*zeros[:place], byte, *zeros[place + 1 :]])) - self._base
                for byte in range(256)
            ]
            for place in range(field.size)
        ]
        # What may follow the first n bytes: the least that they add, the step, and how many.
        self._rest = [self._following(done) for done in range(field.size + 1)]

    def after(self, data: bytes) -> tuple[int, ...]:
        """The class of the field's first bytes."""
        lowest, step, count = self._rest[len(data)]
        begun = self._value(data) + lowest
        return tuple(min(max(-((begun - bound) // step), 0), count) for bound in self._bounds)

    def _value(self, data: bytes) -> int:
        """The value of the field's first bytes, the others zero."""
        parts = zip(self._parts, data, strict=False)
        return int(self._base + sum(part[byte] for part, byte in parts))

    def _following(self, done: int) -> tuple[int, int, int]:
        left = self._parts[done:]
        count = int(256 ** len(left))
        spans = sum(max(part) - min(part) for part in left)
        return sum(map(min, left)), max(1, spans // max(1, count - 1)), count
