"""Renders records as JSON lines."""

from __future__ import annotations

from collections.abc import Iterable

from bilprov.analyzer.decode.json_lines import encode_lines, json_lines
from bilprov.analyzer.decode.records import Record


class JsonText:
    """Renders records as JSON lines, each with its newline; see `json_lines`."""

    def text(self, records: Iterable[Record]) -> str:
        """The lines of the records; a record without a line gives none."""
        return encode_lines(json_lines(records)).decode()
