"""Decodes a whole capture into its Totals, in batches, so that memory stays flat. Needs numpy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bilprov.analyzer.columns.decoder import Part, Records
from bilprov.analyzer.columns.totals import Chosen, Totals
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.replay.capture_parts import Progress, decoded_parts
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter


def capture_totals(
    capture: Capture,
    protocol: Protocol,
    progress: Progress = lambda size: None,
    test: Filter | None = None,
) -> Totals:
    """Decode a capture as `replay` does, and count what passes the filter.

    `progress` is told the number of bytes of each batch. Raises CaptureError as `Capture.events`.
    """
    totals = Totals(protocol)
    for part in decoded_parts(capture, protocol, progress):
        totals.add(part, None if test is None else chosen(part, test))
    return totals


def chosen(part: Part, test: Filter) -> Chosen | list[bool]:
    """What of a part passes a filter: the rows of a Stretch, or each of the records."""

    def passes(record: Record) -> bool:
        line = json_line(record)
        return line is not None and test(line)

    if isinstance(part, Records):
        return list(map(passes, part.listed))
    events = (span for span in part.spans if span.side == "line")
    lines = [passes(part.line(span.start, span.after)) for span in events]
    return Chosen(*test.masks(part), lines)
