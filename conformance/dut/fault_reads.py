"""Records which inputs a fault reads: fields of an Event, counter thresholds, divisors.

So the equivalence search can merge states that the fault cannot distinguish, such as counts beyond
every threshold with which the fault compares them.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

COUNTED = ("frames", "faults", "truncated", "row")
_PREVIOUS = "previous."


class FaultReads:
    """The inputs read so far: names, and each counter's highest threshold and divisors."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self._most: dict[str, int] = {}
        self._divisors: dict[str, set[int]] = {}

    def __len__(self) -> int:
        divisors = sum(len(found) for found in self._divisors.values())
        return len(self.names) + sum(self._most.values()) + divisors

    def compared(self, name: str, value: int) -> None:
        """Record that the counter `name` was compared with this value."""
        self.names.add(name)
        self._most[name] = max(self._most.get(name, 0), value)

    def divided(self, name: str, divisor: int) -> None:
        """Record that the remainder of the counter `name` by this divisor was taken."""
        self.names.add(name)
        self._divisors.setdefault(name, set()).add(divisor)

    def seen(self, name: str, value: int) -> Hashable:
        """The part of the counter's value that can matter to the fault; None if it was not read."""
        if name not in self.names:
            return None
        most = self._most.get(name)
        divisors = sorted(self._divisors.get(name, ()))
        return (
            None if most is None else min(value, most + 1),
            tuple(value % divisor for divisor in divisors),
        )

    def of_previous(self, judgement: object) -> Hashable:
        """The fields that were read of the previous frame's judgement; None without any."""
        if "previous" not in self.names or judgement is None:
            return None
        names = sorted(name for name in self.names if name.startswith(_PREVIOUS))
        return True, tuple(getattr(judgement, name[len(_PREVIOUS) :]) for name in names)


class Count:
    """A counter that records its comparisons and remainders; other arithmetic is a TypeError."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, value: int, name: str, reads: FaultReads, offset: int = 0) -> None:
        self._value = value
        self._name = name
        self._reads = reads
        self._offset = offset

    def _note(self, other: int) -> int:
        self._reads.compared(self._name, other - self._offset)
        return self._value + self._offset

    def __eq__(self, other: object) -> bool:
        return isinstance(other, int) and self._note(other) == other

    def __lt__(self, other: int) -> bool:
        return self._note(other) < other

    def __le__(self, other: int) -> bool:
        return self._note(other) <= other

    def __gt__(self, other: int) -> bool:
        return self._note(other) > other

    def __ge__(self, other: int) -> bool:
        return self._note(other) >= other

    def __bool__(self) -> bool:
        return self._note(0) != 0

    def __add__(self, other: int) -> Count:
        return Count(self._value, self._name, self._reads, self._offset + other)

    def __mod__(self, divisor: int) -> int:
        self._reads.divided(self._name, divisor)
        return (self._value + self._offset) % divisor


class RecordingProxy:
    """A proxy of an Event, or of the previous frame's judgement, that records the fields read."""

    def __init__(self, event: object, reads: FaultReads, prefix: str = "") -> None:
        self._event = event
        self._reads = reads
        self._prefix = prefix

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._event, name)
        if self._prefix:
            self._reads.names.add(self._prefix + name)
        elif name in COUNTED or (name == "gap" and value is not None):
            return Count(value, name, self._reads)
        elif name in ("previous", "previous_kind", "pipelined", "gap"):
            self._reads.names.add(name)
            if name == "previous" and value is not None:
                return RecordingProxy(value, self._reads, _PREVIOUS)
        return value
