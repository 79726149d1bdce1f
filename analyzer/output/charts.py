"""Draws small pictures of characters: sparklines and bars, in blocks or in plain ASCII."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True, slots=True)
class Charts:
    """Draws with these characters.

    `steps` are those of a sparkline from the lowest to the highest, without one for 0, `fills` the
    parts of a bar's last cell from the smallest to a full one.
    """

    steps: str
    fills: str

    def spark(self, values: Sequence[float], width: int) -> str:
        """Values side by side, the largest as high as can be; a mean of several for want of room.

        What is 0 is blank, and what is not is never blank.
        """
        columns = means(values, width)
        most = max(columns, default=0)
        return "".join(self._step(value / most) if value > 0 else " " for value in columns)

    def bar(self, share: float, width: int) -> str:
        """A bar as long as a share (0 to 1) of the width; what is not 0 is never blank."""
        parts = round(share * width * len(self.fills))
        if share > 0:
            parts = max(parts, 1)
        full, rest = divmod(parts, len(self.fills))
        return self.fills[-1] * full + (self.fills[rest - 1] if rest else "")

    def _step(self, share: float) -> str:
        return self.steps[min(int(share * len(self.steps)), len(self.steps) - 1)]


BLOCKS = Charts("▁▂▃▄▅▆▇█", "▏▎▍▌▋▊▉█")
ASCII = Charts(".:-=+*%#", "#")


def means(values: Sequence[float], most: int) -> list[float]:
    """The values, or where there are more than `most` the means of neighbours."""
    count = len(values)
    if count <= most:
        return list(values)
    bounds = [place * count // most for place in range(most + 1)]
    pieces = (values[low:high] for low, high in pairwise(bounds))
    return [sum(piece) / len(piece) for piece in pieces]
