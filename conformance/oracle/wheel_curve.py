"""The wheels' speeds over a sweep of one setting, and what they show (R-resolution). Pure.

No mixing law is given, so a curve is judged by order alone: a wheel is never slower at a higher
speed, and the wheels never differ less at a higher strength of steering. A difference counts where
it exceeds the measured spread by 5 % of full scale or 3 steps, whichever is more.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from statistics import median
from typing import NamedTuple

from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.motion import WHEELS, Motion

READING = "R-resolution"
_SHARE, _STEPS = 0.05, 3  # of full scale; of the probe's numbers
_MARGIN = 1.25  # medians of many settings may lie further apart than looks at one of them
_SHOWN = 3  # plateaus that are told with their bounds


@dataclass(frozen=True, slots=True)
class WheelCurve:
    """The wheels' speeds at each setting of a variable, in one kind of motion.

    `settings` are values of `variable`, from the weakest to the strongest; steering is positive to
    the right. `left` and `right` are the wheels' speeds there, the medians of several looks, and
    `spread` is the most by which looks at one and the same setting differed.
    """

    variable: str
    motion: Motion
    settings: tuple[int, ...]
    left: tuple[int, ...]
    right: tuple[int, ...]
    spread: int = 0

    @property
    def full(self) -> int:
        """Full scale: the largest speed of a wheel, whatever its direction."""
        return max(map(abs, (*self.left, *self.right)), default=0)

    @property
    def noise(self) -> float:
        """The spread to be expected of what is judged: of steering a difference of two speeds."""
        return _MARGIN * self.spread * (2 if self.variable == "steering" else 1)

    @property
    def tolerance(self) -> float:
        """The difference between two settings up to which they count as alike."""
        return self.noise + tolerance(self.full)

    @property
    def graded(self) -> bool:
        """Whether the wheels show speeds, and not just that they turn."""
        shown = {abs(speed) for speed in (*self.left, *self.right)} - {0}
        return len(shown) > 1 and self.full > _STEPS

    @property
    def name(self) -> str:
        """What is swept: the variable and, of steering, the side."""
        if self.variable != "steering":
            return self.variable
        return f"steering-{'right' if self.settings[-1] > 0 else 'left'}"

    def rising(self) -> dict[str, tuple[int, ...]]:
        """The series that must not fall: each wheel's speed, or the difference of the wheels."""
        ahead_left, ahead_right = WHEELS[self.motion]
        left = tuple(ahead_left * speed for speed in self.left)
        right = tuple(ahead_right * speed for speed in self.right)
        if self.variable != "steering":
            return {"left": left, "right": right}
        side = 1 if self.settings[-1] > 0 else -1
        ahead = tuple(side * (a - b) for a, b in zip(left, right, strict=True))
        return {"difference": ahead}

    def at(self, place: int) -> str:
        """Words for the wheels at one setting."""
        return f"{self.variable} {self.settings[place]} turns the wheels with {self._both(place)}"

    def beside(self, place: int, other: int) -> str:
        """Words for the wheels at two settings."""
        return f"{self.at(place)}, {self.settings[other]} with {self._both(other)}"

    def _both(self, place: int) -> str:
        return f"{self.left[place]} (left) and {self.right[place]} (right)"


def tolerance(full: float) -> float:
    """The difference that counts on this full scale where looks do not differ by themselves."""
    return max(_SHARE * full, _STEPS)


def curve_of(
    variable: str, motion: Motion, looks: Iterable[tuple[int, Sequence[tuple[int, int]]]]
) -> WheelCurve:
    """The curve of (setting, looks at it), a look being the speeds (left, right)."""
    settings, lefts, rights, spread = list[int](), list[int](), list[int](), 0
    for setting, seen in looks:
        left, right = ([look[wheel] for look in seen] for wheel in (0, 1))
        settings.append(setting)
        lefts.append(round(median(left)))
        rights.append(round(median(right)))
        spread = max(spread, max(left) - min(left), max(right) - min(right))
    return WheelCurve(variable, motion, tuple(settings), tuple(lefts), tuple(rights), spread)


class Kind(Enum):
    """The kinds of traits of a curve, with the verdicts that they have by R-resolution."""

    REVERSED = Verdict.FAIL
    UNRESOLVED = Verdict.INCONCLUSIVE
    FLAT = Verdict.NON_STRICT
    TOLD = Verdict.INFORMATIONAL


class Trait(NamedTuple):
    """What a curve shows, in words; `places` are the settings' indices that a failure rests on."""

    kind: Kind
    words: str
    places: tuple[int, ...] = ()


def traits(curve: WheelCurve, others: Iterable[WheelCurve] = ()) -> tuple[Trait, ...]:
    """What the curve shows, the worst first; nothing for one that is as expected.

    `others` are the curves measured before on the same device.
    """
    known = tuple(others)
    if not curve.graded and not any(other.graded for other in known):
        words = f"the wheels show a single speed, {curve.full}" if curve.full else "they stand"
        return (Trait(Kind.TOLD, f"{words}: the probe shows no graded speeds"),)
    found = [*_reversed(curve), *_unresolved(curve)]
    if not found:
        found = [*_flat(curve), *_unlike(curve), *_not_mirrored(curve, known)]
    return tuple(sorted(found, key=lambda trait: trait.kind.value, reverse=True))


def _reversed(curve: WheelCurve) -> Iterator[Trait]:
    """The deepest fall of each series, or that it runs against the motion; equal ones once."""
    steers = curve.variable == "steering"
    found: dict[tuple[int, ...], list[str]] = {}
    for name, series in curve.rising().items():
        fall = deepest_fall(series)
        lowest = min(range(len(series)), key=series.__getitem__)
        straight = min(series[0], 0) if steers and not curve.settings[0] else 0
        if fall and series[fall[0]] - series[fall[1]] > curve.tolerance:
            found.setdefault(fall, []).append(name)
        elif straight - series[lowest] > curve.tolerance:
            found.setdefault((lowest,), []).append(name)
    for places, names in found.items():
        several = steers or len(names) > 1
        who = "the wheels" if several else f"the {names[0]} wheel"
        if len(places) == 1:
            what = "steer to the other side" if steers else "turn against the motion"
            yield Trait(Kind.REVERSED, f"{curve.at(places[0])}: {who} {what}", places)
            continue
        slower = f"{'are' if several else 'is'} slower at the higher speed"
        what = "differ less at the higher strength" if steers else slower
        numbers = curve.beside(places[1], places[0])
        yield Trait(Kind.REVERSED, f"{numbers}: {who} {what}", places)


def deepest_fall(series: Sequence[int]) -> tuple[int, int] | None:
    """The places (before, after) between which a series falls most, None if it never falls."""
    top, found, deepest = 0, None, 0
    for place, value in enumerate(series):
        if value >= series[top]:
            top = place
        elif series[top] - value > deepest:
            found, deepest = (top, place), series[top] - value
    return found


def _unresolved(curve: WheelCurve) -> Iterator[Trait]:
    """Looks that differ so much that the whole sweep is within their spread."""
    rise = max(max(series) - min(series) for series in curve.rising().values())
    if curve.spread > tolerance(curve.full) and rise <= curve.tolerance:
        words = f"observations of one setting differ by {curve.spread}, all settings by {rise}"
        yield Trait(Kind.UNRESOLVED, f"the probe cannot resolve this sweep: {words}")


def _flat(curve: WheelCurve) -> Iterator[Trait]:
    """The plateaus and the dead zone."""
    found: dict[tuple[int, int], list[str]] = {}
    for name, series in curve.rising().items():
        for bounds in plateaus(curve.settings, series, curve.noise, curve.tolerance):
            found.setdefault(bounds, []).append(name)
    words = []
    for (first, last), names in sorted(found.items()):
        bounds_words = f"{curve.variable} {curve.settings[first]} to {curve.settings[last]}"
        level = max(abs(series[last]) for series in curve.rising().values())
        who = "" if len(names) == len(curve.rising()) else f" ({' and '.join(names)})"
        dead = first == 0 and level <= curve.noise
        words.append(f"{bounds_words} {'is a dead zone' if dead else 'are alike'}{who}")
    if words:
        more = f" and {len(words) - _SHOWN} more plateaus" if len(words) > _SHOWN else ""
        yield Trait(Kind.FLAT, f"{', '.join(words[:_SHOWN])}{more}")


def plateaus(
    settings: Sequence[int], series: Sequence[int], spread: float, least: float
) -> Iterator[tuple[int, int]]:
    """The places (first, last) between which a series stays within `spread`, where that counts.

    It counts where a straight line through the whole series would rise by more than `least`.
    """
    if len(series) < 2:
        return
    across = abs(settings[-1] - settings[0])
    scale = max(map(abs, series))
    first = 0
    while first < len(series) - 1:
        last = first
        low = high = series[first]
        while last + 1 < len(series):
            low, high = min(low, series[last + 1]), max(high, series[last + 1])
            if high - low > spread:
                break
            last += 1
        if abs(settings[last] - settings[first]) / across * scale > least:
            yield first, last
            first = last
        first += 1


def _unlike(curve: WheelCurve) -> Iterator[Trait]:
    """Wheels that differ although the robot drives straight on."""
    if curve.variable == "steering":
        return
    apart = [abs(abs(a) - abs(b)) for a, b in zip(curve.left, curve.right, strict=True)]
    most = max(range(len(apart)), key=apart.__getitem__)
    if apart[most] > curve.spread + curve.tolerance:
        yield Trait(Kind.TOLD, f"not alike when straight: {curve.at(most)}")


def _not_mirrored(curve: WheelCurve, others: Sequence[WheelCurve]) -> Iterator[Trait]:
    """Steering to one side that makes another curve than to the other side."""
    if curve.variable != "steering":
        return
    for other in others:
        if other.variable != curve.variable or other.name == curve.name:
            continue
        mine, theirs = _curving(curve), _curving(other)
        there = {abs(setting): place for place, setting in enumerate(other.settings)}
        both = [(i, there[abs(s)]) for i, s in enumerate(curve.settings) if abs(s) in there]
        most = max(both, key=lambda pair: abs(mine[pair[0]] - theirs[pair[1]]), default=None)
        if most is None:
            continue
        noise = 2 * (curve.noise + other.noise)  # of four differences
        apart = abs(mine[most[0]] - theirs[most[1]])
        if apart > noise + tolerance(max(curve.full, other.full)):
            words = f"{curve.at(most[0])}, {other.at(most[1])}"
            yield Trait(Kind.TOLD, f"left and right are not mirrored: {words}")


def _curving(curve: WheelCurve) -> tuple[int, ...]:
    """How much more the wheels differ at each strength than they do when straight."""
    (ahead,) = curve.rising().values()
    straight = 0 if curve.settings[0] else ahead[0]
    return tuple(value - straight for value in ahead)
