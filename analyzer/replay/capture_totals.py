"""Decodes a whole capture into its Totals, in batches, so that memory stays flat. Needs numpy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bilprov.analyzer.replay.capture_parts import Progress, decoded_batches
from bilprov.analyzer.totals.totals import Totals
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

    `progress` is given the number of bytes of each batch. Raises CaptureError as `Capture.events`.
    """
    totals = Totals(protocol)
    for batch in decoded_batches(capture, protocol, progress):
        totals.add(batch, None if test is None else test.selection(batch))
    return totals
