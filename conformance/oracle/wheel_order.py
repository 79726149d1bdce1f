"""Judges the order of the wheels' speeds at a few settings of one variable (R-resolution). Pure.

No mixing law is given, so only order counts: no wheel is slower at a higher speed, the wheels never
differ less at a stronger steering, and half speed is slower than full. A difference counts where it
exceeds the measured spread by 5 % of full scale or 3 steps, whichever is more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from statistics import median

from bilprov.conformance.oracle.verdicts import Verdict

_SHARE, _STEPS = 0.05, 3  # of full scale; of the probe's numbers
_MARGIN = 1.25  # medians at several settings may lie further apart than looks at one of them

Speeds = tuple[int, int]


def sizes(looks: Mapping[int, Sequence[Speeds]]) -> set[int]:
    """The speeds at which a wheel was seen turning, whatever its direction; several are graded."""
    return {abs(speed) for seen in looks.values() for both in seen for speed in both} - {0}


def spread(seen: Sequence[Speeds]) -> int:
    """By how much looks at one setting differ at most."""
    left, right = ([both[side] for both in seen] for side in (0, 1))
    return max(max(left) - min(left), max(right) - min(right))


def tolerance(full: float) -> float:
    """The difference that counts on this full scale where looks do not differ by themselves."""
    return max(_SHARE * full, _STEPS)


def judge_order(
    variable: str, ahead: Speeds, looks: Mapping[int, Sequence[Speeds]], *, steers: bool
) -> tuple[Verdict, str, str]:
    """The worst verdict on the order, what was seen at the ends, and the reason; a pass has none.

    `ahead` is how the wheels (left, right) turn in the motion. `looks` are the speeds (left, right)
    seen at each setting of the variable, in ascending order. With `steers` it is the steering,
    positive to the right.
    """
    settings = tuple(looks)
    wheels = [[round(median(wheel)) for wheel in zip(*s, strict=True)] for s in looks.values()]
    differ = max(map(spread, looks.values()))
    full = max(abs(speed) for both in wheels for speed in both)
    noise = _MARGIN * differ * (1 + steers)
    counts = noise + tolerance(full)
    left, right = ([turns * both[side] for both in wheels] for side, turns in enumerate(ahead))
    rising = [[a - b for a, b in zip(left, right, strict=True)]] if steers else [left, right]
    pairs = list(combinations(range(len(settings)), 2))
    found: list[tuple[Verdict, str]] = []

    def at(*places: int) -> str:
        seen = ", ".join(
            "{} with {} (left) and {} (right)".format(settings[place], *wheels[place])
            for place in places
        )
        return f"{variable} turns the wheels at {seen}"

    words = f"{at(0, -1)}; observations differ by {differ} at most"
    # Wheels that are slower, or differ less, at the higher of two settings.
    for series in rising:
        first, last = max(pairs, key=lambda pair: series[pair[0]] - series[pair[1]])
        if series[first] - series[last] > counts:
            slower = "differ less at the stronger one" if steers else "are slower at the higher"
            found.append((Verdict.FAIL, f"{at(first, last)}: they {slower}"))
    # From half speed to full the wheels are faster; from left to right they turn over.
    half = min(settings, key=lambda value: abs(2 * value - settings[-1]))
    first = 0 if steers else settings.index(half)
    if min(series[-1] - series[first] for series in rising) <= counts:
        if differ > tolerance(full):
            found.append((Verdict.INCONCLUSIVE, f"the probe cannot resolve it: {words}"))
        elif not steers and 4 * counts <= full:
            found.append((Verdict.FAIL, f"{at(first, -1)}: half speed is as fast as full"))
    # Settings that count and are alike, the longest stretch of them.
    for series in rising:
        # What of the range a straight line would need for a rise that counts.
        least = (settings[-1] - settings[0]) * (counts + noise) / max(1, *map(abs, series))
        for first, last in pairs:
            alike = series[first : last + 1]
            low, high = settings[first], settings[last]
            if max(alike) - min(alike) <= noise and high - low > least:
                least = high - low
                found.append((Verdict.NON_STRICT, f"{variable} {low} to {high} are alike"))
    # Wheels that differ straight on, or another curve to one side than to the other.
    curve = dict(zip(settings, rising[0], strict=True))
    for place, value in enumerate(settings) if steers else ():
        if value <= 0 or not {0, -value} <= curve.keys():
            continue
        if abs(curve[value] + curve[-value] - 2 * curve[0]) > counts + 3 * noise:
            where = at(settings.index(-value), place)
            found.append((Verdict.INFORMATIONAL, f"not mirrored: {where}"))
    apart = [abs(abs(a) - abs(b)) for a, b in wheels]
    if not steers and max(apart) > differ + counts:
        where = at(apart.index(max(apart)))
        found.append((Verdict.INFORMATIONAL, f"not alike when straight: {where}"))
    verdict, reason = max(found, key=lambda judged: judged[0], default=(Verdict.PASS, ""))
    return verdict, words, reason
