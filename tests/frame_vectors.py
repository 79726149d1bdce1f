"""The form of hand-typed vectors of a framed request/answer protocol (tests/vectors_*.py)."""

from __future__ import annotations

from collections.abc import Mapping
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


def request(
    clause: str,
    hexed: str,
    name: str | None,
    outcome: str = "valid",
    to: int | None = None,
    **fields: Any,
) -> RequestVector:
    """A request; its bytes are written in hex, `to` is the address in them."""
    return RequestVector(clause, bytes.fromhex(hexed), to, name, outcome, fields)


def reply(clause: str, asked: str, hexed: str, code: str = "", **fields: Any) -> ReplyVector:
    """An answer and the request that it answers; both are written in hex."""
    return ReplyVector(clause, bytes.fromhex(hexed), bytes.fromhex(asked), code, fields)
