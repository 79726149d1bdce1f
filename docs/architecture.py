"""Writes the table of rooms in ARCHITECTURE.md and draws architecture.svg, both from the code.

Promises are the packages' first docstring lines, arrows their real imports. Only where a box stands
is said here.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Hashable, Iterable, Iterator, Mapping
from functools import cache
from html import escape
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple, TypeVar

from tests.support import ROOT
from tests.test_layers import RANKS, ROOMS, imports, module_name, product, rank_of

DOCUMENT, PICTURE = "ARCHITECTURE.md", "architecture.svg"
BEGIN, END = "<!-- rooms: written by make pictures -->", "<!-- end of rooms -->"
FRONT_DOOR = "bilprov"
GROUND = ("spec", "captures")  # what nearly every room imports: named in no box

Node = TypeVar("Node", bound=Hashable)


class Place(NamedTuple):
    """Where a room's box stands in its package: row from the top, left edge and width (0 to 1)."""

    row: int
    left: float
    width: float


# By the first name of each entry of ROOMS.
PLACES = {
    "bilprov": Place(0, 0, 1),
    "conformance.cli": Place(0, 0.55, 0.45),
    "conformance.pytest_plugin": Place(0, 0, 0.52),
    "conformance.mutation": Place(1, 0.49, 0.51),
    "conformance.learning": Place(1, 0, 0.45),
    "conformance.api": Place(2, 0, 0.6),
    "conformance.causes": Place(2, 0.62, 0.38),
    "conformance.runner": Place(3, 0, 1),
    "conformance.report": Place(4, 0, 1),
    "conformance.cases": Place(5, 0, 1),
    "conformance.oracle": Place(6, 0, 0.6),
    "conformance.machines": Place(6, 0.62, 0.38),
    "conformance": Place(7, 0, 1),
    "analyzer.cli": Place(0, 0, 1),
    "analyzer.doctor": Place(1, 0, 0.25),
    "analyzer.pipeline": Place(1, 0.28, 0.15),
    "analyzer.edit": Place(1, 0.46, 0.09),
    "analyzer.export": Place(1, 0.58, 0.12),
    "analyzer.screen": Place(1, 0.73, 0.12),
    "analyzer.plot": Place(1, 0.88, 0.12),
    "analyzer.taps": Place(2, 0.29, 0.11),
    "analyzer.replay": Place(2, 0.43, 0.16),
    "analyzer.output": Place(2, 0.65, 0.18),
    "analyzer.html": Place(2, 0.88, 0.12),
    "analyzer.client": Place(3, 0, 0.19),
    "analyzer.simulated": Place(3, 0.25, 0.16),
    "analyzer.filters": Place(3, 0.7, 0.15),
    "analyzer.transport": Place(4, 0.27, 0.17),
    "analyzer.monitor": Place(4, 0.5, 0.15),
    "analyzer.totals": Place(4, 0.7, 0.15),
    "analyzer": Place(5, 0, 0.21),
    "analyzer.decode": Place(5, 0.23, 0.62),
    "captures.reader": Place(0, 0, 0.38),
    "captures.storage": Place(0, 0.42, 0.16),
    "captures": Place(0, 0.62, 0.38),
    "spec.emit": Place(0, 0, 0.12),
    "spec.grammars": Place(0, 0.15, 0.16),
    "spec.arrays": Place(0, 0.34, 0.14),
    "spec": Place(0, 0.5, 0.5),
}

_ROWS = (("bilprov",), ("analyzer", "conformance"), ("captures",), ("spec",))
_WIDTH, _EDGE, _PAD, _GAP, _HEADING = 1060, 10, 12, 26, 28
_ASIDE = 660  # width of the analyzer's panel, beside the suite's
_TITLE, _NOTE, _LINE = 9.4, 7.4, 17  # px: a letter of a title, of a note, a line of text

_STYLE = """
text { font-family: system-ui, 'DejaVu Sans', Arial, sans-serif; fill: #1b1f24 }
.heading { font-size: 18px; font-weight: 700 }
.title { font-size: 16px; font-weight: 600; text-anchor: middle }
.note { font-size: 13px; text-anchor: middle; fill: #4a525c }
.page { fill: #ffffff }
.box { fill: #ffffff; stroke: #68717c }
.bilprov { fill: #e6e8eb } .conformance { fill: #eadff7 } .analyzer { fill: #fbe9cb }
.captures { fill: #d5efdb } .spec { fill: #d4e6fb }
.arrow { stroke: #3a424b; stroke-width: 1.6; fill: none }
.head { fill: #3a424b }
@media (prefers-color-scheme: dark) {
text { fill: #e9edf1 } .note { fill: #b4bcc5 } .page { fill: #0f1318 }
.box { fill: #161b22; stroke: #8b949e }
.bilprov { fill: #2a3037 } .conformance { fill: #3a2c52 } .analyzer { fill: #4a3a17 }
.captures { fill: #1d4429 } .spec { fill: #1b3a5e }
.arrow { stroke: #c3cad2 } .head { fill: #c3cad2 }
}
"""


def package_of(rank: int) -> str:
    """The package that a room belongs to."""
    return ROOMS[rank][0].partition(".")[0]


@cache
def imported() -> dict[int, dict[int, set[str]]]:
    """For each room the rooms it imports, each with the names by which a note calls them."""
    found: dict[int, dict[int, set[str]]] = {rank: {} for rank in range(len(ROOMS))}
    for path in product():
        own = rank_of(module_name(path))
        for line in imports((ROOT / path).read_text(encoding="utf-8")):
            rank = rank_of(line.module)
            if own is None or rank is None or rank == own:
                continue
            # Of bilprov.PACKAGE.NAME.MODULE the name is a folder, or a module at the root.
            found[own].setdefault(rank, set()).add(line.module.split(".")[:3][-1])
    return found


def reduced(graph: Mapping[Node, set[Node]]) -> dict[Node, set[Node]]:
    """The graph without the arrows that follow from others."""

    def below(node: Node) -> set[Node]:
        return graph[node].union(*(below(other) for other in graph[node]))

    return {node: ends - set().union(*map(below, ends)) for node, ends in graph.items()}


def promise(package: str) -> str:
    """The first line of a package's docstring."""
    folder = ROOT / "src" / package if package == FRONT_DOOR else ROOT / package.replace(".", "/")
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    return (ast.get_docstring(tree) or "").split("\n")[0]


def table() -> str:
    """The table of the packages with their promises, from the ground up."""
    rows = ["| room | what it does |", "|---|---|"]
    for name in (name for group in ROOMS for name in group):
        path = f"src/{name}" if name == FRONT_DOOR else name.replace(".", "/")
        if (ROOT / path).is_dir():
            rows.append(f"| [{path}/](../{path}) | {promise(name)} |")
    return "\n".join(rows)


def title(rank: int) -> str:
    """A room by name: its folder, or its modules where it is modules at a package's root."""
    names: list[str] = []
    for name in ROOMS[rank]:
        folder = ROOT / name.replace(".", "/")
        if name == FRONT_DOOR:
            names.append("__main__ and __init__: the command, and the names for Python")
        elif "." not in name:
            modules = sorted(path.stem for path in folder.glob("*.py"))
            names += [m for m in modules if m[0] != "_" and f"bilprov.{name}.{m}" not in RANKS]
        else:
            names.append(folder.name + "/" * folder.is_dir())
    return ", ".join(names)


class Box(NamedTuple):
    """A rectangle of the picture, in px."""

    left: float
    top: float
    width: float
    height: float

    @property
    def right(self) -> float:
        """Its right edge."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """Its lower edge."""
        return self.top + self.height

    def svg(self, kind: str) -> str:
        """The rectangle as an element."""
        return (
            f'<rect class="{kind}" x="{self.left:.0f}" y="{self.top:.0f}" '
            f'width="{self.width:.0f}" height="{self.height:.0f}" rx="6"/>'
        )


def arrow(upper: Box, lower: Box, others: Iterable[Box]) -> str:
    """An arrow from a box to one that is below it, past the others, or beside it in its row."""
    if lower.top < upper.bottom:  # beside it
        y = (max(upper.top, lower.top) + min(upper.bottom, lower.bottom)) / 2
        sides = (upper.left, lower.right) if lower.left < upper.left else (upper.right, lower.left)
        return _path(f"M{sides[0]:.0f} {y:.0f}H{sides[1]:.0f}")
    x = (max(upper.left, lower.left) + min(upper.right, lower.right)) / 2
    start, end = (min(max(x, b.left + 8), b.right - 8) for b in (upper, lower))
    in_the_way = [
        box
        for box in others
        if (upper.bottom <= box.top and box.bottom <= lower.top)
        and (box.left < max(start, end) and min(start, end) < box.right)
    ]
    if in_the_way:  # around them, on the right
        x = max(box.right for box in (upper, lower, *in_the_way)) + _PAD
        y, down = upper.top + upper.height / 2, lower.top + lower.height / 2
        curve = f"C{x:.0f} {y:.0f} {x:.0f} {down:.0f}"
        return _path(f"M{upper.right:.0f} {y:.0f}{curve} {lower.right:.0f} {down:.0f}")
    return _path(f"M{start:.0f} {upper.bottom:.0f}L{end:.0f} {lower.top:.0f}")


def arrows(graph: Mapping[Node, set[Node]], boxes: Mapping[Node, Box]) -> Iterator[str]:
    """Every arrow of a graph between the boxes of its nodes."""
    for node, ends in graph.items():
        for end in sorted(boxes[other] for other in ends):
            yield arrow(boxes[node], end, boxes.values())


def _path(line: str) -> str:
    return f'<path class="arrow" marker-end="url(#head)" d="{line}"/>'


class Room(NamedTuple):
    """A room's box as it is to be drawn: its lines, and its place."""

    rank: int
    title: list[str]
    note: list[str]
    place: Place

    @property
    def height(self) -> float:
        """Its height in px."""
        return 12 + _LINE * (len(self.title) + len(self.note))


class Panel:
    """One package: its rooms in rows, on ground of its own colour."""

    def __init__(self, package: str, width: float, uses: Mapping[int, Mapping[int, set[str]]]):
        self.package = package
        self.width = width
        self.rooms = [
            self._room(rank, uses[rank])
            for rank in range(len(ROOMS))
            if package_of(rank) == package
        ]
        rows = range(1 + max(room.place.row for room in self.rooms))
        self._heights = [max(r.height for r in self.rooms if r.place.row == row) for row in rows]

    def _room(self, rank: int, uses: Mapping[int, set[str]]) -> Room:
        place = PLACES[ROOMS[rank][0]]
        inside = place.width * (self.width - 2 * _PAD) - 10
        others: dict[str, set[str]] = {}
        for other, names in uses.items():
            if package_of(other) not in (self.package, *GROUND):
                others.setdefault(package_of(other), set()).update(names)
        note = "; ".join(f"{name}: {', '.join(sorted(others[name]))}" for name in sorted(others))
        return Room(
            rank,
            wrap(title(rank), int(inside / _TITLE), break_long_words=False),
            wrap(note, int(inside / _NOTE), break_long_words=False),
            place,
        )

    @property
    def height(self) -> float:
        """The least height in px that holds all rows."""
        return _HEADING + sum(self._heights) + _GAP * (len(self._heights) - 1) + _PAD

    def boxes(self, around: Box) -> Iterator[tuple[Room, Box]]:
        """The box of each room, the rows spread over the height that there is."""
        gaps = max(1, len(self._heights) - 1)
        gap = _GAP + (around.height - self.height) / gaps
        inside = self.width - 2 * _PAD
        for room in self.rooms:
            row = room.place.row
            top = around.top + _HEADING + sum(self._heights[:row]) + gap * row
            left = around.left + _PAD + room.place.left * inside
            yield room, Box(left, top, room.place.width * inside, self._heights[row])


def picture() -> str:
    """The packages and their rooms as SVG, each above what it imports."""
    uses = imported()
    whole = _WIDTH - 2 * _EDGE
    beside = {"analyzer": _ASIDE, "conformance": whole - _ASIDE - _GAP}
    panels = {name: Panel(name, beside.get(name, whole), uses) for row in _ROWS for name in row}
    grounds = _grounds(panels)
    height = max(ground.bottom for ground in grounds.values()) + _EDGE
    parts = [Box(0, 0, _WIDTH, height).svg("page")]
    boxes: dict[int, Box] = {}
    for name, ground in grounds.items():
        parts.append(ground.svg(name))
        parts.append(_text("heading", ground.left + _PAD, ground.top + 19, name))
        for room, box in panels[name].boxes(ground):
            boxes[room.rank] = box
            parts += _drawn(room, box)
    inside: dict[int, set[int]] = {rank: set() for rank in uses}
    between: dict[str, set[str]] = {name: set() for name in panels}
    for rank, others in uses.items():
        own = package_of(rank)
        inside[rank] = {other for other in others if package_of(other) == own}
        between[own] |= {package_of(other) for other in others} - {own}
    parts += [*arrows(reduced(inside), boxes), *arrows(reduced(between), grounds)]
    head = (
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto"><path class="head" d="M0 0L8 4L0 8z"/></marker>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height:.0f}" '
        'role="img" aria-label="The packages and rooms of bilprov, each above what it imports">\n'
        f"<style>{_STYLE}</style>\n<defs>{head}</defs>\n" + "\n".join(parts) + "\n</svg>\n"
    )


def _grounds(panels: Mapping[str, Panel]) -> dict[str, Box]:
    """Where each package's panel stands: the rows from top to bottom."""
    grounds: dict[str, Box] = {}
    top = float(_EDGE)
    for names in _ROWS:
        height = max(panels[name].height for name in names)
        left = float(_EDGE)
        for name in names:
            grounds[name] = Box(left, top, panels[name].width, height)
            left += panels[name].width + _GAP
        top += height + _GAP
    return grounds


def _text(kind: str, x: float, y: float, text: str) -> str:
    return f'<text class="{kind}" x="{x:.0f}" y="{y:.0f}">{escape(text)}</text>'


def _drawn(room: Room, box: Box) -> Iterator[str]:
    yield box.svg("box")
    lines = [*(("title", line) for line in room.title), *(("note", line) for line in room.note)]
    y = box.top + (box.height - _LINE * len(lines)) / 2 + 12
    for kind, line in lines:
        yield _text(kind, box.left + box.width / 2, y, line)
        y += _LINE


def drawn(folder: Path) -> dict[Path, str]:
    """What the document and the picture of that folder ought to hold."""
    document = folder / DOCUMENT
    rooms = f"{BEGIN}\n{table()}\n{END}"
    old = document.read_text(encoding="utf-8")
    new = re.sub(f"{BEGIN}.*?{END}", lambda _: rooms, old, flags=re.DOTALL)
    return {document: new, folder / PICTURE: picture()}


if __name__ == "__main__":
    for file, text in drawn(Path(sys.argv[1])).items():
        file.write_text(text, encoding="utf-8")
