"""Compiles filter expressions (`--filter EXPR`) and asks which rows of a batch pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bilprov.analyzer.filters.checking import checked
from bilprov.analyzer.filters.fields import bytes_names
from bilprov.analyzer.filters.syntax import parse
from bilprov.analyzer.filters.tree import Node
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch, Selection

_LATEST = 1 << 62  # ns since 1970; with a recording's length it still fits into 64 bits


@dataclass(frozen=True, slots=True)
class Filter:
    """A compiled filter.

    `start` is the wall clock (ns since 1970) at the recording's start. Where it is not known no row
    has a time of day, and no comparison with `time` holds.
    """

    tree: Node
    protocol: Protocol
    start: int | None = None

    def started(self, start_wall: int) -> Filter:
        """The filter for a recording that began at this time (ns since 1970).

        A start that no clock shows (0 or less, or after the year 2116) counts as unknown.
        """
        return replace(self, start=start_wall if 0 < start_wall < _LATEST else None)

    def selection(self, batch: Batch) -> Selection:
        """Which rows of a batch pass."""
        from bilprov.analyzer.filters.masks import selection

        return selection(self.tree, self.protocol, batch, self.start)


def compile_filter(text: str, protocol: Protocol) -> Filter:
    """Compile a filter, which asks for rows of this protocol.

    The names are those of `fields_of(protocol)`. Raises FilterError, in one sentence that begins
    with the column.
    """
    return Filter(checked(parse(text, bytes_names(protocol)), protocol), protocol)
