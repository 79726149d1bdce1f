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

READING = "R-resolution"
_SHARE, _STEPS = 0.05, 3  # of full scale; of the probe's numbers
_MARGIN = 1.25  # medians at several settings may lie further apart than looks at one of them

Speeds = tuple[int, int]
Judged = tuple[Verdict, str]


def sizes(looks: Mapping[int, Sequence[Speeds]]) -> set[int]:
    """The speeds at which a wheel was seen turning, whatever its direction; several are graded."""
    return {abs(speed) for seen in looks.values() for both in seen for speed in both} - {0}


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
        ahead: tuple[int, int],
        looks: Mapping[int, Sequence[Speeds]],
        *,
        steers: bool,
    ) -> None:
        self._variable, self._settings = variable, tuple(looks)
        wheels = [tuple(zip(*seen, strict=True)) for seen in looks.values()]
        self._spread = max(max(wheel) - min(wheel) for both in wheels for wheel in both)
        self._wheels = [(round(median(left)), round(median(right))) for left, right in wheels]
        self._full = max(map(abs, (speed for both in self._wheels for speed in both)))
        self._steers = steers
        self._noise = _MARGIN * self._spread * (1 + self._steers)
        self._tolerance = self._noise + tolerance(self._full)
        ahead_left, ahead_right = ahead
        left = [ahead_left * left for left, _ in self._wheels]
        right = [ahead_right * right for _, right in self._wheels]
        difference = [a - b for a, b in zip(left, right, strict=True)]
        self._rising = [difference] if self._steers else [left, right]

    @property
    def words(self) -> str:
        """What was seen at the ends."""
        return f"{self._at(0, -1)}; observations differ by {self._spread} at most"

    def verdict(self) -> Judged:
        """The worst verdict on the order, and its reason; a pass has none."""
        judgements = (self._falls, self._rise, self._plateaus, self._unlike, self._not_mirrored)
        found = [judged for judgement in judgements for judged in judgement()]
        return max(found, key=lambda judged: judged[0], default=(Verdict.PASS, ""))

    def _at(self, *places: int) -> str:
        seen = ", ".join(
            "{} with {} (left) and {} (right)".format(self._settings[place], *self._wheels[place])
            for place in places
        )
        return f"{self._variable} turns the wheels at {seen}"

    def _falls(self) -> Iterator[Judged]:
        slower = "differ less at the stronger one" if self._steers else "are slower at the higher"
        for series in self._rising:
            pairs = combinations(range(len(series)), 2)
            first, last = max(pairs, key=lambda pair: series[pair[0]] - series[pair[1]])
            if series[first] - series[last] > self._tolerance:
                yield Verdict.FAIL, f"{self._at(first, last)}: they {slower}"

    def _rise(self) -> Iterator[Judged]:
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
            counts = (self._tolerance + self._noise) / max(1, *map(abs, series))
            least = across * counts
            for first, last in combinations(range(len(series)), 2):
                alike, reach = (
                    series[first : last + 1],
                    self._settings[last] - self._settings[first],
                )
                if max(alike) - min(alike) <= self._noise and reach > least:
                    least = reach
                    bounds = f"{self._settings[first]} to {self._settings[last]}"
                    yield Verdict.NON_STRICT, f"{self._variable} {bounds} are alike"

    def _unlike(self) -> Iterator[Judged]:
        """Wheels that differ although the robot drives straight on."""
        apart = [abs(abs(left) - abs(right)) for left, right in self._wheels]
        if not self._steers and max(apart) > self._spread + self._tolerance:
            place = apart.index(max(apart))
            yield Verdict.INFORMATIONAL, f"not alike when straight: {self._at(place)}"

    def _not_mirrored(self) -> Iterator[Judged]:
        """Steering to one side that makes another curve than to the other side."""
        if not self._steers:
            return
        curve = dict(zip(self._settings, self._rising[0], strict=True))
        for value in curve:
            if value > 0 and -value in curve and 0 in curve:
                bend = abs(curve[value] + curve[-value] - 2 * curve[0])
                if bend > self._tolerance + 3 * self._noise:
                    places = map(self._settings.index, (-value, value))
                    yield Verdict.INFORMATIONAL, f"not mirrored: {self._at(*places)}"
