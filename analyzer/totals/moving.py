"""The time for which the car moves, as the instructions predict it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class MovingTime:
    """Adds up for how long the wheels turn, change by change."""

    def __init__(self, moving: bool) -> None:
        self._total = 0  # ns, up to the last change
        self._since: int | None = None
        self._moving = moving

    def follow(
        self, t: NDArray[np.int64], moving: NDArray[np.bool_], asked: tuple[int, ...] = ()
    ) -> list[int]:
        """Take the next times (ns) at which the state was set, and whether the wheels turn then.

        Returns for how long (ns) they had turned at each of the times `asked` for, which are not
        before the changes that came with an earlier call.
        """
        begin = min([*asked, *t[:1].tolist()], default=0) if self._since is None else self._since
        turns = np.append(self._moving, moving)
        changes = np.flatnonzero(turns[1:] != turns[:-1])
        at = np.maximum.accumulate(np.append(begin, t[changes]))
        turns = np.append(self._moving, moving[changes])
        total = self._total + np.append(0, np.cumsum(np.diff(at) * turns[:-1]))
        self._total, self._since, self._moving = int(total[-1]), int(at[-1]), bool(turns[-1])
        places = np.searchsorted(at, asked, "right") - 1
        return [
            int(total[place]) + max(0, time - int(at[place])) * bool(turns[place])
            for place, time in zip(places.clip(0).tolist(), asked, strict=True)
        ]
