"""The statistics that `bilprov stats` shows of captures, as the values of its JSON.

The JSON of `--json` is one object. Times and durations are in seconds:

- `grammar`: `name`, `version` and `sha256` of the grammar by which the bytes were decoded.
- `filter`: the expression of `--filter`, null without it; only what it lets pass is counted.
- `files`: for each capture, in the order in which they were named:
  - `path`; `unfinished` (the recording was cut short) and `damage` (a sentence for each part of the
    file that is left out).
  - `line`: the line settings, like `115200 8N1`; the grammar's where the file has none.
  - `first`, `last`: when the first and the last byte came, from the start of the recording; null
    where there is no byte.
  - `counts`: see below.
  - `rates`: counts by time, at most 1,024 of each, null where there is nothing to count: they begin
    at `start` (from the start of the recording) and each is of `step` seconds; `frames` that ended,
    `faults`, `host_bytes` and `device_bytes`.
- `total`: the counts of all files together.

Counts have these keys:

- `duration`: from the first byte to the last; in `total` the sum.
- `moving`: for how long of that the wheels turned, as the instructions predict.
- `load`: the share of what the line can carry in that time, 0 to 1: `host` and `device`; null where
  the duration is 0.
- `host_bytes`, `device_bytes`: bytes on the line.
- `frames`: host frames, of which `truncated` were cut short; `garbage` counts runs of host bytes
  that belong to no frame.
- `peak`: the largest number of frames that ended in one second, counted from the start.
- `instructions`: frames by the name of the instruction, and `unused 9` for an ID that has none.
- `expected`: frames by the response that a conforming device gives them.
- `responses`: bytes of the device by the name of the response, and `unused 9` for other codes.
- `agreeing`, `disagreeing`: answers that are the expected one; others, and all unused codes.
- `anomalies`: by kind, as `faults` of the JSON lines names them.
- `by_direction`: `anomalies` again, of the `host`, of the `device` and of `neither`.
- `by_instruction`: for each of `instructions`: `frames`, `responses` (its answers), `anomalies` (of
  its frames and their answers; a missing answer has no frame, and is in `anomalies` alone) and
  `latency`.
- `latency`: null where nothing is paired, else `count`, `min`, `median`, `p95`, `p99`, `max`: from
  the last byte of a frame to its answer; `min` and `max` are exact, the rest are of latencies
  rounded down to 1 us, between two of them interpolated linearly.
- `latency_bins`: a histogram of all latencies: how many (`count`) are from `least` up to, not
  including, `below`. 95 of 100 fall into bins of equal width, the last bin has what is left.

Instructions and responses of the grammar are there even where the count is 0.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeAlias

from bilprov.analyzer.output.console import parts_of
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.totals.totals import Rates, Spread, Totals

SECOND = 1e9  # ns

Json: TypeAlias = dict[str, Any]
"""An object of the JSON; the module's docstring explains the keys."""


def stats_of(
    protocol: Protocol, files: list[Json], together: Totals, expression: str | None = None
) -> Json:
    """The statistics of captures; `together` are the totals of all of them."""
    duration = sum(file["counts"]["duration"] for file in files)
    spans = [(file["counts"]["load"], file["counts"]["duration"]) for file in files]
    mean = {  # of the files that have a load, which have a duration
        side: sum(load[side] * seconds for load, seconds in spans if load) / (duration or 1)
        for side in ("host", "device")
    }
    return {
        "grammar": parts_of(protocol, "name", "version", "sha256"),
        "filter": expression,
        "files": files,
        "total": _counts(together, duration, mean if duration else None),
    }


def file_stats(capture: Capture, totals: Totals, line: LineSettings) -> Json:
    """The statistics of one capture with these totals, recorded on such a line."""
    first, last = totals.first, totals.last
    duration = ((last or 0) - (first or 0)) / SECOND
    load = None
    if duration:
        share = line.byte_time / SECOND / duration  # of one byte
        load = {"host": totals.host_bytes * share, "device": totals.device_bytes * share}
    return {
        "path": str(capture.path),
        **parts_of(capture, "unfinished", "damage"),
        "line": str(line),
        "first": None if first is None else first / SECOND,
        "last": None if last is None else last / SECOND,
        "counts": _counts(totals, duration, load),
        "rates": _rates(totals.rates),
    }


def _rates(rates: Rates) -> Json | None:
    names = ("frames", "faults", "host_bytes", "device_bytes")
    if not rates.series("frames"):
        return None
    series = {name: rates.series(name) for name in names}
    return {"start": rates.start / SECOND, "step": rates.width / SECOND, **series}


def _counts(totals: Totals, duration: float, load: Json | None) -> Json:
    instructions = totals.instructions()
    directions = {"host": "host", "device": "device", "neither": ""}
    return {
        "duration": duration,
        "moving": totals.moving / SECOND,
        "load": load,
        **parts_of(totals, "host_bytes", "device_bytes", "frames"),
        "truncated": totals.kinds["truncated"],
        "garbage": totals.kinds["garbage"],
        "peak": totals.peak,
        "instructions": {name: found.frames for name, found in instructions.items()},
        "expected": totals.expected(),
        "responses": totals.responses(),
        **parts_of(totals, "agreeing", "disagreeing"),
        "anomalies": dict(totals.faults_of().most_common()),
        "by_direction": {
            name: dict(totals.faults_of(side).most_common()) for name, side in directions.items()
        },
        "by_instruction": {
            name: parts_of(found, "frames", "responses")
            | {"anomalies": found.faults, "latency": spread_json(found.latencies)}
            for name, found in instructions.items()
        },
        "latency": spread_json(totals.latencies.spread()),
        "latency_bins": [
            {"least": start / SECOND, "below": stop / SECOND, "count": amount}
            for start, stop, amount in totals.latencies.histogram()
        ],
    }


def spread_json(spread: Spread | None) -> Json | None:
    """How latencies are spread, in seconds; None where there are none."""
    if spread is None:
        return None
    return {
        name: value if name == "count" else value / SECOND for name, value in asdict(spread).items()
    }
