"""Turns the text of a CSV cell back, as whoever reads such a file may do."""

from __future__ import annotations

import re

_ESCAPED = re.compile(r"\\(\\|[tnr]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")
_NAMED = {"\\": "\\", "t": "\t", "n": "\n", "r": "\r"}


def plain(cell: str) -> str:
    """The text that `row_columns.neutral` was given."""
    return _ESCAPED.sub(
        lambda found: _NAMED.get(found[1]) or chr(int(found[1][1:], 16)), cell.removeprefix("'")
    )
