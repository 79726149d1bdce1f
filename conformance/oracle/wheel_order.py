"""Judges the order of the wheels' speeds at a few settings of one variable (R-resolution). Pure.

No mixing law is given, so only order counts: no wheel is slower at a higher speed, the wheels never
differ less at a stronger steering, and half speed is slower than full. A difference counts where it
exceeds the measured spread by 5 % of full scale or 3 steps, whichever is more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from statistics import median

from bilprov.conformance.oracle.verdicts import Verdict

_SHARE, _STEPS = 0.05, 3  # of full scale; of the probe's numbers
_MARGIN = 1.25  # medians at several settings may lie further apart than looks at one of them

Speeds = tuple[int, int]
Judged = tuple[Verdict, str]


def sizes(looks: Mapping[int, Sequence[Speeds]]) -> set[int]:
    """The speeds at which a wheel was seen turning, whatever its direction; several are graded."""
    return {abs(speed) for seen in looks.values() for both in seen for speed in both} - {0}


def spread(seen: Sequence[Speeds]) -> int:
    """By how much looks at one setting differ at most."""
    return max(
        max(wheel) - min(wheel)
        for wheel in ([left for left, _ in seen], [right for _, right in seen])
    )


def tolerance(full: float) -> float:
    """The difference that counts on this full scale where looks do not differ by themselves."""
    return max(_SHARE * full, _STEPS)


class WheelOrder:
    """The wheels in a motion at the settings of a variable, in ascending order.

    `ahead` is how the wheels (left, right) turn in the motion. `looks` are the speeds (left, right)
    seen at each setting. With `steers` the variable is the steering, positive to the right.
    """

    def __init__(
        self,
        variable: str,
        ahead: Speeds,
        looks: Mapping[int, Sequence[Speeds]],
        *,
        steers: bool,
    ) -> None:
        self._variable, self._settings, self._steers = variable, tuple(looks), steers
        self._spread = max(map(spread, looks.values()))
        self._wheels = [
            [round(median(wheel)) for wheel in zip(*seen, strict=True)] for seen in looks.values()
        ]
        self._full = max(abs(speed) for both in self._wheels for speed in both)
        self._noise = _MARGIN * self._spread * (1 + steers)
        self._tolerance = self._noise + tolerance(self._full)
        left, right = (
            [turns * speed for speed in wheel]
            for turns, wheel in zip(ahead, zip(*self._wheels, strict=True), strict=True)
        )
        difference = [a - b for a, b in zip(left, right, strict=True)]
        self._rising = [difference] if steers else [left, right]
        self._pairs = list(combinations(range(len(looks)), 2))

    @property
    def words(self) -> str:
        """What was seen at the ends."""
        return f"{self._at(0, -1)}; observations differ by {self._spread} at most"

    def verdict(self) -> Judged:
        """The worst verdict on the order, and its reason; a pass has none."""
        found = [*self._falls(), *self._flat(), *self._plateaus(), *self._uneven()]
        return max(found, key=lambda judged: judged[0], default=(Verdict.PASS, ""))

    def _at(self, *places: int) -> str:
        seen = ", ".join(
            "{} with {} (left) and {} (right)".format(self._settings[place], *self._wheels[place])
            for place in places
        )
        return f"{self._variable} turns the wheels at {seen}"

    def _falls(self) -> Iterator[Judged]:
        """Wheels that are slower, or differ less, at the higher of two settings."""
        slower = "differ less at the stronger one" if self._steers else "are slower at the higher"
        for series in self._rising:
            first, last = max(self._pairs, key=lambda pair: series[pair[0]] - series[pair[1]])
            if series[first] - series[last] > self._tolerance:
                yield Verdict.FAIL, f"{self._at(first, last)}: they {slower}"

    def _flat(self) -> Iterator[Judged]:
        """From half speed to full the wheels are faster; from left to right they turn over."""
        half = min(self._settings, key=lambda value: abs(2 * value - self._settings[-1]))
        first = 0 if self._steers else self._settings.index(half)
        if min(series[-1] - series[first] for series in self._rising) > self._tolerance:
            return
        if self._spread > tolerance(self._full):
            yield Verdict.INCONCLUSIVE, f"the probe cannot resolve it: {self.words}"
        elif not self._steers and 4 * self._tolerance <= self._full:
            yield Verdict.FAIL, f"{self._at(first, -1)}: half speed is as fast as full"

    def _plateaus(self) -> Iterator[Judged]:
        """Settings that count and are alike, the longest stretch of them."""
        across = self._settings[-1] - self._settings[0]
        for series in self._rising:
            # What of the range a straight line would need for a rise that counts.
            least = across * (self._tolerance + self._noise) / max(1, *map(abs, series))
            for first, last in self._pairs:
                alike = series[first : last + 1]
                low, high = self._settings[first], self._settings[last]
                if max(alike) - min(alike) <= self._noise and high - low > least:
                    least = high - low
                    yield Verdict.NON_STRICT, f"{self._variable} {low} to {high} are alike"

    def _uneven(self) -> Iterator[Judged]:
        """Wheels that differ straight on, or another curve to one side than to the other."""
        if not self._steers:
            apart = [abs(abs(left) - abs(right)) for left, right in self._wheels]
            if max(apart) > self._spread + self._tolerance:
                where = self._at(apart.index(max(apart)))
                yield Verdict.INFORMATIONAL, f"not alike when straight: {where}"
            return
        curve = dict(zip(self._settings, self._rising[0], strict=True))
        for place, value in enumerate(self._settings):
            if value > 0 and -value in curve and 0 in curve:
                bend = abs(curve[value] + curve[-value] - 2 * curve[0])
                if bend > self._tolerance + 3 * self._noise:
                    where = self._at(self._settings.index(-value), place)
                    yield Verdict.INFORMATIONAL, f"not mirrored: {where}"
