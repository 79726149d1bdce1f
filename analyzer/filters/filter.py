"""Compiles filter expressions (`--filter EXPR`) for JSON lines and for columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bilprov.analyzer.decode.json_lines import JsonLine
from bilprov.analyzer.filters.checking import checked
from bilprov.analyzer.filters.syntax import parse
from bilprov.analyzer.filters.tree import Lines, Node
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch

    from bilprov.analyzer.filters.columns import Mask


class Filter:
    """A compiled filter: called with a JSON line, it tells whether the line passes.

    `start` is the wall clock (ns since 1970) at the recording's start. Where it is not known no row
    has a time of day, and no comparison with `time` holds.
    """

    def __init__(self, tree: Node, protocol: Protocol, start: int | None = None) -> None:
        self._tree = tree
        self._protocol = protocol
        self._start = start
        self._test = Lines(protocol, start).test(tree)

    def __call__(self, line: JsonLine) -> bool:
        """Whether the line passes."""
        return self._test(line)

    def started(self, start_wall: int) -> Filter:
        """The filter for a recording that began at this time (ns since 1970).

        A start that no clock shows (0 or less, or after the year 2116) counts as unknown.
        """
        known = 0 < start_wall < _LATEST
        return Filter(self._tree, self._protocol, start_wall if known else None)

    def masks(self, stretch: Stretch) -> tuple[Mask, Mask]:
        """Which of the new host rows pass, and which device rows. Line events are not asked."""
        from bilprov.analyzer.filters.masks import masks

        return masks(self._tree, stretch, self._start)


_LATEST = 1 << 62  # ns since 1970; with a recording's length it still fits into 64 bits


def compile_filter(text: str, protocol: Protocol) -> Filter:
    """Compile a filter, which tells whether a JSON line or a row of columns passes.

    The names are those of `fields_of(protocol)`. Raises FilterError, in one sentence that begins
    with the column.
    """
    return Filter(checked(parse(text), protocol), protocol)
