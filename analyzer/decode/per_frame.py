"""Makes something of the host's frames, which are mostly ones that came before."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from bilprov.analyzer.decode.records import HostRecord
from bilprov.spec.codec import Judgement

Made = TypeVar("Made")

_MOST = 1 << 14  # frames that are remembered


class PerFrame(Generic[Made]):
    """Calls `make` for a record of the host, and remembers what it gave for the next such frame.

    What is made must depend on the bytes and their judgement alone, and on why the frame is
    uncertain. What is made of garbage, or of an uncertain frame, is not remembered.
    """

    def __init__(self, make: Callable[[HostRecord], Made]) -> None:
        self._make = make
        self._known: dict[bytes, tuple[Judgement, Made]] = {}

    def __call__(self, record: HostRecord) -> Made:
        """What is made of a record."""
        judgement = record.judgement
        if judgement is None or record.note:
            return self._make(record)
        known = self._known.get(judgement.frame)
        if known is None or known[0] is not judgement:  # another grammar judges it otherwise
            if len(self._known) >= _MOST:
                self._known.clear()
            known = self._known[judgement.frame] = judgement, self._make(record)
        return known[1]
