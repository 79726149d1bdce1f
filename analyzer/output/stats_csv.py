"""Writes the statistics of captures as one tidy CSV table: a row for each number.

The columns are `file` (empty for all files together), `group`, `key`, `measure` and `value`; times
are in seconds, names are those of the JSON (see `capture_stats`):

| group | key | measure |
|---|---|---|
| `total` | | each number of the counts, `load.host`, `load.device` |
| `instruction` | its name | `frames` |
| `response` | its name | `expected`, `given` |
| `anomaly` | its kind | `host`, `device`, `neither` |
| `latency` | an instruction, or nothing for all | `count`, `min`, `median`, `p95`, `p99`, `max` |
| `answer` | an instruction | a response: how often it was the answer |
| `instruction anomaly` | an instruction | a kind: how often its frames and answers had it |
| `latency bin` | the bin's lower end | `count` |
| `rate` | the time at which a step begins | `frames`, `faults`, `host_bytes`, `device_bytes` |

Text is harmless where it is opened, as in the CSV of frames (`csv_text`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

from bilprov.analyzer.output.capture_stats import Json
from bilprov.analyzer.output.csv_text import csv_cell

HEADER = ("file", "group", "key", "measure", "value")
Row: TypeAlias = tuple[str, str | float, str, int | float]
"""Group, key, measure and value."""


def stats_csv(stats: Json) -> str:
    """The whole table with its header."""
    rows: list[tuple[str | float, ...]] = [HEADER]
    for file in stats["files"]:
        rows += ((file["path"], *row) for row in _rows(file["counts"]))
        rows += ((file["path"], *row) for row in (_rates(file["rates"]) if file["rates"] else ()))
    if len(stats["files"]) > 1:
        rows += (("", *row) for row in _rows(stats["total"]))
    return "".join(",".join(map(csv_cell, row)) + "\r\n" for row in rows)


def _rows(counts: Json) -> Iterator[Row]:
    for measure, value in counts.items():
        if isinstance(value, int | float):
            yield "total", "", measure, value
    if counts["load"]:
        yield "total", "", "load.host", counts["load"]["host"]
        yield "total", "", "load.device", counts["load"]["device"]
    for name, count in counts["instructions"].items():
        yield "instruction", name, "frames", count
    for name, count in counts["expected"].items():
        yield "response", name, "expected", count
    for name, count in counts["responses"].items():
        yield "response", name, "given", count
    for side, kinds in counts["by_direction"].items():
        for kind, count in kinds.items():
            yield "anomaly", kind, side, count
    latencies = {"": counts["latency"]}
    latencies |= {name: found["latency"] for name, found in counts["by_instruction"].items()}
    for name, latency in latencies.items():
        for measure, value in (latency or {}).items():
            yield "latency", name, measure, value
    for name, found in counts["by_instruction"].items():
        for response, count in found["responses"].items():
            yield "answer", name, response, count
        for kind, count in found["anomalies"].items():
            yield "instruction anomaly", name, kind, count
    for bin in counts["latency_bins"]:
        yield "latency bin", bin["least"], "count", bin["count"]


def _rates(rates: Json) -> Iterator[Row]:
    series = {name: value for name, value in rates.items() if isinstance(value, list)}
    for place in range(len(rates["frames"])):
        for name, counts in series.items():
            yield "rate", rates["start"] + place * rates["step"], name, counts[place]
