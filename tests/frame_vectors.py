"""The form of hand-typed vectors of a framed request/answer protocol (tests/vectors_*.py).

A vector is a row of a table, its columns divided by ` | `; a line that is indented goes on with the
row before. Frames are written in hex, fields as Python's keyword arguments, `-` is nothing.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple


class RequestVector(NamedTuple):
    """A frame of the host and what a conforming device makes of it.

    `name` is None for an unknown instruction; `fields` are empty unless the frame is whole.
    `outcome` is one of: valid, unknown-id, bad-data, too-many, too-few, truncated, bad-checksum,
    bad-sync. `address` is None in a protocol without one.
    """

    clause: str
    frame: bytes
    address: int | None
    name: str | None
    outcome: str
    fields: Mapping[str, Any]


class ReplyVector(NamedTuple):
    """A frame of the device, the request that it answers, and what it reports.

    `code` is the name of the code that it carries, "" in an answer without one.
    """

    clause: str
    frame: bytes
    request: bytes
    code: str
    fields: Mapping[str, Any]


def requests(table: str) -> tuple[RequestVector, ...]:
    """Rows of a frame, `NAME` or `OUTCOME: NAME`, `to` (the address) with the fields, a clause."""
    made = []
    for frame, word, values, clause in _rows(table):
        outcome, _, name = word.rpartition(":")
        fields = _fields(values)
        to = fields.pop("to", None)
        given = bytes.fromhex(frame), to, name.strip() or None, outcome or "valid"
        made.append(RequestVector(clause, *given, fields))
    return tuple(made)


def replies(table: str) -> tuple[ReplyVector, ...]:
    """Rows of a request and its answer divided by `>`, the code, the fields, a clause."""
    made = []
    for frames, code, values, clause in _rows(table):
        asked, answer = map(bytes.fromhex, frames.split(">"))
        made.append(ReplyVector(clause, answer, asked, code.strip("-"), _fields(values)))
    return tuple(made)


def _rows(table: str) -> Iterator[list[str]]:
    for row in table.replace("\n    ", " ").strip().splitlines():
        if not row.startswith("#"):
            yield row.split(" | ")


def _fields(written: str) -> dict[str, Any]:
    call = ast.parse(f"fields({written.strip('-')})", mode="eval").body
    assert isinstance(call, ast.Call)
    return {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
