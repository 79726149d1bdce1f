"""The curves of the wheels' speeds as pictures: one for each sweep, one line for each wheel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from bilprov.analyzer.html.markup import Safe, joined, tag
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.report.schema import WheelCurve

_WIDTH, _HEIGHT = 420, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 12, 14, 34  # the margins, where the axes' words stand


def wheel_curves(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """A picture of each curve that a report has, under its name where there are several."""
    parts = []
    for name, report in zip(told, reports, strict=True):
        curves = _curves(report)
        if not curves:
            continue
        if len(reports) > 1:
            parts.append(tag("h4", name))
        full = max(max(map(abs, (*curve.left, *curve.right))) for curve in curves) or 1
        pictures = (_figure(curve, full) for curve in curves)
        parts.append(tag("div", *pictures, class_="curves"))
    if not parts:
        return Safe("")
    keys = (
        tag("span", tag("span", "", class_=f"key {wheel}"), f"{wheel} wheel")
        for wheel in ("left", "right")
    )
    legend = tag("p", *keys, class_="legend")
    return joined([tag("h3", "Speeds of the wheels"), legend, *parts])


def _curves(report: Report) -> list[WheelCurve]:
    """The curves of a report; none where they are not such (a later kit may have written them)."""
    try:
        return msgspec.convert(report.profile.get("wheels") or [], list[WheelCurve], strict=False)
    except msgspec.ValidationError:
        return []


def _figure(curve: WheelCurve, full: int) -> Safe:
    """One sweep: the settings to the right, the wheels' speeds upwards, -full to full or from 0."""
    title = f"{curve.variable} {curve.settings[0]} to {curve.settings[-1]}"
    motion = curve.motion.replace("_", " ")
    least, most = min(*curve.left, *curve.right), max(*curve.left, *curve.right)
    # A wheel that trembles around 0 does not open the other half of the picture.
    low = -full if least < -full / 8 else 0
    high = full if most > full / 8 or low == 0 else 0
    across = _Scale(min(curve.settings), max(curve.settings), _LEFT, _WIDTH - _RIGHT)
    up = _Scale(low, high, _HEIGHT - _BOTTOM, _TOP)
    ends = f"{curve.left[0]} to {curve.left[-1]} (left), {curve.right[0]} to {curve.right[-1]}"
    about = (
        f"Speeds of the wheels while driving {motion}, at {len(curve.settings)} settings: "
        f"{ends} (right). Observations of one setting differ by {curve.spread} at most."
    )
    lines = [
        _line(wheel, across, up, curve.settings, speeds)
        for wheel, speeds in (("left", curve.left), ("right", curve.right))
    ]
    picture = tag(
        "svg", tag("title", title), tag("desc", about), *_axes(across, up), *lines,
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}", role="img", class_="wheels",
    )  # fmt: skip
    spread = f", spread {curve.spread}" if curve.spread else ""
    return tag("figure", picture, tag("figcaption", f"{title}, {motion}{spread}"))


class _Scale:
    """A linear scale from values to units of the picture."""

    def __init__(self, low: int, high: int, start: int, end: int) -> None:
        self.low, self.high = low, high
        self._start, self._step = start, (end - start) / ((high - low) or 1)

    def __call__(self, value: int) -> str:
        return f"{self._start + (value - self.low) * self._step:.1f}"

    def ticks(self) -> list[int]:
        """The ends, the middle, and 0 where it is between them."""
        middle = (self.low + self.high) // 2
        return sorted({self.low, 0 if self.low < 0 < self.high else middle, self.high})


def _axes(across: _Scale, up: _Scale) -> list[Safe]:
    parts = []
    for value in up.ticks():
        y = up(value)
        parts.append(
            tag("line", x1=_LEFT, x2=_WIDTH - _RIGHT, y1=y, y2=y, class_="zero" * (value == 0))
        )
        parts.append(tag("text", value, x=_LEFT - 6, y=y, class_="speed"))
    for value in across.ticks():
        parts.append(tag("text", value, x=across(value), y=_HEIGHT - _BOTTOM + 20, class_="set"))
    return parts


def _line(
    wheel: str, across: _Scale, up: _Scale, settings: Sequence[int], speeds: Sequence[int]
) -> Safe:
    points = " ".join(f"{across(s)},{up(v)}" for s, v in zip(settings, speeds, strict=True))
    attributes: dict[str, Any] = {"points": points, "class_": wheel}
    return tag("polyline", **attributes)
