"""Other people's programs on both sides of `sniff --bridge`, and what it makes of their traffic."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from tests.support.commands import command, running


@contextmanager
def bridged(grammar: str, device: str, capture: Path) -> Iterator[str]:
    """Sniff between a device's port and the port that is given, into a capture."""
    words = ("--bridge", device, "--quiet", "-w", str(capture))
    with running("--grammar", grammar, "sniff", *words) as sniffing:
        yield sniffing.stderr.readline().decode().strip()
        code, _, told = sniffing.end()
    assert code == 0, told


class Traffic:
    """A capture as `replay` decodes it: its frames, its requests, and the answer to each of them.

    An answer is found by the number (`sequence`) of its request. Fails where a byte is in no frame.
    That a busy machine did not read for a while is no frame.
    """

    def __init__(self, capture: Path) -> None:
        done = command("replay", str(capture), "--format", "jsonl")
        assert done.returncode == 0, done.stderr
        rows: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
        self.frames = [row for row in rows if row["kind"] != "line" and row["name"] != "waited"]
        self.requests = [row for row in self.frames if row["direction"] == "host"]
        answers = [row for row in self.frames if row["direction"] == "device"]
        self.answers = {row["answers"]: row for row in answers}
        sent = [event for event in open_capture(capture) if isinstance(event, Chunk)]
        for direction, frames in (("host", self.requests), ("device", answers)):
            data = b"".join(chunk.data for chunk in sent if chunk.direction == direction)
            assert b"".join(bytes.fromhex(frame["hex"]) for frame in frames) == data

    def require_nothing_odd(self, faulty: int = 0) -> None:
        """Every frame is a request with one answer that agrees, or that answer.

        A broadcast has none. So many requests are `faulty`, and are answered too.
        """
        odd = [one["faults"] for one in self.frames if one["faults"] or one["agrees"] is False]
        assert odd == [["faulty instruction"]] * faulty
        assert {one["kind"] for one in self.frames} == {"instruction", "response"}
        due = {one["sequence"] for one in self.requests if one.get("address") != 0}
        assert set(self.answers) == due
        assert len(self.frames) == len(self.requests) + len(due)
