"""Real lines for tests: what arrives on them, and lines of JSON."""

from __future__ import annotations

import json
import select
from typing import Any

from bilprov.analyzer.transport.port import Port, PtyPair


def json_lines(output: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in output.splitlines()]


def master_gives(pty: PtyPair, count: int) -> bytes:
    """So many bytes that were written to a pty."""
    data = b""
    while len(data) < count:
        select.select([pty.master], [], [])
        data += pty.read()
    return data


def read_from(port: Port, count: int) -> bytes:
    """Read `count` bytes; the test's own time limit ends a wait that is in vain."""
    data = b""
    while len(data) < count:
        select.select([port], [], [])
        data += port.read()
    return data
