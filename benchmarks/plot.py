"""Draws the bench's plot as SVG: how many times faster than construct, on a logarithmic scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from math import ceil, floor, log10

from benchmarks.report import CONSTRUCT, Row, times

_WIDTH, _LEFT, _RIGHT, _TOP = 900, 300, 70, 62  # px
_BAR, _GAP, _HEAD = 15, 4, 22  # px: a bar, the room under it, the title of a group
_STYLE = """
  text { font: 12px system-ui, sans-serif; fill: #1f2328; }
  .title { font-size: 15px; font-weight: 600; }
  .work { font-weight: 600; stroke: #ffffff; stroke-width: 5px; paint-order: stroke; }
  .quiet { fill: #59636e; }
  .back { fill: #ffffff; }
  .grid { stroke: #d1d9e0; }
  .one { stroke: #59636e; }
  .ours { fill: #0969da; }
  .peer { fill: #afb8c1; }
  .goal { stroke: #cf222e; stroke-width: 2; }
  @media (prefers-color-scheme: dark) {
    text { fill: #f0f6fc; }
    .quiet { fill: #9198a1; }
    .back { fill: #0d1117; }
    .work { stroke: #0d1117; }
    .grid { stroke: #2f353d; }
    .one { stroke: #9198a1; }
    .ours { fill: #4493f8; }
    .peer { fill: #5b636d; }
    .goal { stroke: #f85149; }
  }
"""


def as_svg(rows: Sequence[Row]) -> str:
    """The plot of the rows that were measured beside construct; the others are left out."""
    drawn = [row for row in rows if row.ours and row.base]
    bars = [[*_ratios(row).values(), *_goal(row)] for row in drawn]
    ratios = [ratio for group in bars for ratio in group if ratio > 0]
    low = min(0, floor(log10(min(ratios, default=1))))
    high = max(1, ceil(log10(max(ratios, default=1))))
    height = _TOP + 34 + sum(_HEAD + len(_ratios(row)) * (_BAR + _GAP) + 10 for row in drawn)

    def x(ratio: float) -> float:
        return _LEFT + (log10(ratio) - low) / (high - low) * (_WIDTH - _LEFT - _RIGHT)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{height}" '
        f'viewBox="0 0 {_WIDTH} {height}" role="img" aria-labelledby="t">',
        f'<title id="t">{_title()}</title>',
        f"<style>{_STYLE}</style>",
        f'<rect class="back" width="{_WIDTH}" height="{height}" rx="6"/>',
        f'<text class="title" x="16" y="26">{_title()}</text>',
        '<text class="quiet" x="16" y="46">construct = 1; the red line is what is to be reached; '
        "logarithmic scale; every group was measured in one run</text>",
    ]
    for power in range(low, high + 1):
        at = f"{x(10.0**power):.1f}"
        kind = "one" if power == 0 else "grid"
        lines.append(f'<line class="{kind}" x1="{at}" x2="{at}" y1="{_TOP}" y2="{height - 26}"/>')
        label = f"{10.0**power:,.{max(0, -power)}f}"
        lines.append(
            f'<text class="quiet" x="{at}" y="{height - 10}" text-anchor="middle">{label}</text>'
        )
    y = _TOP
    for row in drawn:
        y += _HEAD
        lines.append(f'<text class="work" x="16" y="{y - 6}">{_plain(row.work)}</text>')
        begin = y
        for name, ratio in _ratios(row).items():
            lines += _bar(name, ratio, x(1), x(ratio), y)
            y += _BAR + _GAP
        for goal in _goal(row):
            at = f"{x(goal):.1f}"
            lines.append(
                f'<line class="goal" x1="{at}" x2="{at}" y1="{begin - 3}" y2="{begin + _BAR + 3}"/>'
            )
        y += 10
    return "\n".join([*lines, "</svg>", ""])


def _plain(words: str) -> str:
    return escape(words.replace("`", ""))


def _title() -> str:
    return "Frames per second as a multiple of construct's"


def _ratios(row: Row) -> dict[str, float]:
    """Each bar of a row: the figure as a multiple of construct's."""
    peers = {
        name: value / row.base
        for name, value in row.peers.items()
        if not name.startswith(CONSTRUCT)
    }
    return {"bilprov": (row.ours or 0) / row.base} | peers


def _goal(row: Row) -> list[float]:
    return [goal.limit for goal in row.goals if f" x {CONSTRUCT}" in goal.text]


def _bar(name: str, ratio: float, one: float, end: float, y: int) -> Iterator[str]:
    begin, width = min(one, end), max(1.0, abs(end - one))
    middle = y + _BAR - 3
    kind = "ours" if name == "bilprov" else "peer"
    yield f'<text x="{_LEFT - 16}" y="{middle}" text-anchor="end">{escape(name)}</text>'
    yield f'<rect class="{kind}" x="{begin:.1f}" y="{y}" width="{width:.1f}" height="{_BAR}"/>'
    yield f'<text x="{max(one, end) + 7:.1f}" y="{middle}">{times(ratio)}</text>'
