"""The looks of a run through a probe that is not the kit's own, and whether they can be believed.

A look that differs from the one before it is made again at once: what two looks in a row show is
believed. A single look that the next contradicts is odd, and counted: it fails no robot, and lets
none pass. Where many are odd, no look is believed any more.
"""

from __future__ import annotations

from typing import Any

import msgspec

from bilprov.analyzer.client.operations import Observation, Procedure, observe
from bilprov.captures.schemas import Look
from bilprov.captures.text import quantity

_AGAIN = 3  # looks that are made again for one, where they go on differing
_ODD, _FEW = 0.03, 4  # share of odd looks from which on none is believed, and at least so many
_UNKNOWN = 20  # looks, as if they had been made before the first
_WHEELS = ("left", "right")


class Looks:
    """The looks of a run. `made` counts them, `odd` those that the next one contradicted.

    Only where they are `confirmed` is a look that differs made again; else each is taken as it is.
    """

    def __init__(self, *, confirmed: bool) -> None:
        self.made = 0
        self.odd = 0
        self._confirmed = confirmed
        self._last: Any = None

    @property
    def contradictory(self) -> bool:
        """Whether so many looks were odd that none can be believed."""
        return self.odd >= _FEW and self.odd > _ODD * self.made

    @property
    def words(self) -> str:
        """How many were odd, in a sentence; "" where none was."""
        if not self.odd:
            return ""
        were = "was" if self.odd == 1 else "were"
        return (
            f"the probe contradicts itself: {self.odd} of {quantity(self.made, 'observation')} "
            f"{were} contradicted by the next one; check that it answers with what it sees when it "
            "is asked"
        )

    @property
    def wrong(self) -> float:
        """How likely one look is wrong that was taken for right, at most, by those made so far."""
        rate = (self.odd + 1) / (self.made + _UNKNOWN)
        return rate**2 if self._confirmed else max(rate, _ODD)

    def observe(self) -> Procedure[Observation]:
        """Look at the robot; again where the look differs from the last one that was believed."""
        seen = yield from observe()
        self.made += 1
        shown = _shown(seen.look)
        if not self._confirmed or shown is None or shown == self._last:
            return seen
        known = [self._last, shown]
        for _ in range(_AGAIN):
            again = yield from observe()
            self.made += 1
            shown = _shown(again.look)
            if shown == known[-1]:
                seen = seen._replace(now=again.now)
                break
            self.odd += self._last is None or shown in known
            seen = again
            if shown is None or shown == self._last:
                return seen
            known.append(shown)
        self._last = shown
        return seen


def _shown(look: Look) -> tuple[object, ...] | None:
    """What of two looks must be alike; None where it is unknown whether the robot moves.

    How fast the wheels turn may vary.
    """
    if look.moving is None:
        return None
    told = msgspec.structs.asdict(look) | {"t": 0}
    told |= {side: (told[side] > 0) - (told[side] < 0) for side in _WHEELS if told[side]}
    return tuple(told.values())
