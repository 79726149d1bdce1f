"""`bilprov stats`: what captures hold, counted; for people, and as JSON for programs."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

from bilprov.analyzer.output import capture_stats
from bilprov.analyzer.replay.capture_decoding import capture_totals
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.commands import command, process
from tests.support.decoding import MS, Event

pytestmark = pytest.mark.slow  # more than make quick has time for

EXAMPLES = str(ROOT / "captures" / "samples" / "examples.mcap")


def written(path: Path, events: Sequence[Event], **metadata: str) -> str:
    metadata = {"attached": "no", "heard": "host device", **metadata}
    return str(write_capture(path, events, metadata))


def counted(*arguments: str) -> Any:
    result = command("stats", *arguments, "--json", "-")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_load_percentiles_and_time_moving_are_those_worked_out_by_hand(tmp_path: Path) -> None:
    # 200 instructions of two bytes, 30 ms apart, at 9600 bit/s with 10 bits a byte.
    latencies = [1] * 197 + [5, 5, 9]  # ms
    events: list[Event] = []
    for place, latency in enumerate(latencies):
        sent = b"\x11\x7f" if place else b"\x20"  # the first one is Forward
        events += [
            Chunk(30 * place * MS, "host", sent),
            Chunk((30 * place + latency) * MS, "device", b"\0"),
        ]
    long = written(tmp_path / "long.mcap", events, line="9600 8N1")
    short = written(tmp_path / "short.mcap", events[:40], line="9600 8N1")

    found = counted(long, short)

    first, second = (file["counts"] for file in found["files"])
    assert (first["duration"], second["duration"]) == (pytest.approx(5.979), pytest.approx(0.571))
    assert first["moving"] == pytest.approx(5.949)  # from the first Speed to the last answer
    assert first["load"] == {
        "host": pytest.approx(399 / 960 / 5.979),
        "device": pytest.approx(200 / 960 / 5.979),
    }
    together = found["total"]
    assert together["moving"] == pytest.approx(5.949 + 0.541)
    assert together["load"] == {
        "host": pytest.approx((399 + 39) / 960 / 6.55),
        "device": pytest.approx((200 + 20) / 960 / 6.55),
    }
    spread = {"min": 0.001, "median": 0.001, "p95": 0.001, "p99": 0.005, "max": 0.009}
    assert first["latency"] == {"count": 200, **spread}
    assert (first["peak"], together["peak"]) == (34, 34)
    assert found["files"][0]["rates"]["frames"] == [34, 33, 33, 34, 33, 33]
    shown = " ".join(command("stats", long).stdout.decode().split())
    assert "load: host 7 %, device 3.5 %" in shown
    assert re.search(r"frames \S+ 33.45 34 ", shown)  # the mean is by the duration


def test_every_key_is_explained() -> None:
    found = counted(EXAMPLES)
    file, total = found["files"][0], found["total"]
    keys = {*found, *file, *total, *file["rates"], *found["grammar"]}
    keys |= {*total["latency"], *total["load"], *total["latency_bins"][0]}
    keys |= {*total["by_direction"], *next(iter(total["by_instruction"].values()))}

    explained = set(re.findall(r"`(\w+)`", capture_stats.__doc__ or ""))

    assert keys <= explained


def test_progress_is_told_all_bytes_in_batches(tmp_path: Path, protocol: Protocol) -> None:
    stops, answers = bytes([protocol.pad_byte]) * 4096, bytes(4096)
    events: list[Event] = []
    for number in range(200):
        events += [Chunk(number * MS, "host", stops), Chunk(number * MS, "device", answers)]
    events.insert(7, Line(3 * MS, "break"))
    told: list[int] = []

    totals = capture_totals(
        open_capture(written(tmp_path / "c.mcap", events)), protocol, told.append
    )

    assert sum(told) == 2 * totals.host_bytes == 400 * 4096
    assert max(told) <= 1 << 20  # so that memory stays flat
    assert len(told) > 1


def busy(protocol: Protocol, seconds: int) -> list[Event]:
    """A recording with every instruction, answers of many latencies, and a line that is full."""
    random, events = Random(1), []
    for second in range(seconds):
        for _ in range(random.randrange(20)):
            header = random.randrange(256)
            frame = bytes([header]) + random.randbytes(protocol.lengths[header])
            t = second * 1000 * MS + random.randrange(900) * MS
            events.append(Chunk(t, "host", frame))
            events.append(Chunk(t + random.randrange(90 * MS), "device", random.randbytes(1)))
    return sorted(events, key=lambda event: event.t)


@pytest.mark.parametrize(("encoding", "block"), [("utf-8", "█"), ("ascii", "#")])
def test_the_tables_fit_80_columns_in_any_encoding(
    tmp_path: Path, protocol: Protocol, encoding: str, block: str
) -> None:
    file = written(tmp_path / "c.mcap", busy(protocol, 90))

    result = process("stats", file, cwd=tmp_path, env={"PYTHONIOENCODING": encoding})

    shown = result.stdout.decode(encoding)
    lines = shown.replace(str(tmp_path), "").splitlines()
    assert (result.returncode, result.stderr) == (0, b"")
    assert block * 10 in shown
    assert max(map(len, lines)) <= 80
    assert all(line.isprintable() for line in lines)
