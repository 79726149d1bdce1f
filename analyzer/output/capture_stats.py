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

from typing import TYPE_CHECKING

import msgspec

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.captures.reader import Capture
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.totals.latencies import Spread
    from bilprov.analyzer.totals.rates import Rates
    from bilprov.analyzer.totals.totals import Totals

SECOND = 1e9  # ns


class Grammar(msgspec.Struct, frozen=True):
    """The grammar by which the bytes were decoded."""

    name: str
    version: str
    sha256: str


class Latency(msgspec.Struct, frozen=True):
    """How the latencies of the answers are spread, in s."""

    count: int
    min: float
    median: float
    p95: float
    p99: float
    max: float


class LatencyBin(msgspec.Struct, frozen=True):
    """How many latencies are from `least` up to, not including, `below`, in s."""

    least: float
    below: float
    count: int


class Load(msgspec.Struct, frozen=True):
    """The share of what the line can carry that each side used, 0 to 1."""

    host: float
    device: float


class InstructionCounts(msgspec.Struct, frozen=True):
    """The counts of one instruction; the module's docstring explains the keys."""

    frames: int
    responses: dict[str, int]
    anomalies: dict[str, int]
    latency: Latency | None


class Counts(msgspec.Struct, frozen=True, kw_only=True):
    """The counts of one capture, or of several; the module's docstring explains the keys."""

    duration: float
    moving: float
    load: Load | None
    host_bytes: int
    device_bytes: int
    frames: int
    truncated: int
    garbage: int
    peak: int
    instructions: dict[str, int]
    expected: dict[str, int]
    responses: dict[str, int]
    agreeing: int
    disagreeing: int
    anomalies: dict[str, int]
    by_direction: dict[str, dict[str, int]]
    by_instruction: dict[str, InstructionCounts]
    latency: Latency | None
    latency_bins: list[LatencyBin]


class RateCounts(msgspec.Struct, frozen=True):
    """Counts by time, in equal steps; the module's docstring explains the keys."""

    start: float
    step: float
    frames: list[int]
    faults: list[int]
    host_bytes: list[int]
    device_bytes: list[int]


class FileStats(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of one capture; the module's docstring explains the keys."""

    path: str
    unfinished: bool
    damage: tuple[str, ...]
    line: str
    first: float | None
    last: float | None
    counts: Counts
    rates: RateCounts | None


class Stats(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of some captures; the module's docstring explains the keys."""

    grammar: Grammar
    filter: str | None
    files: list[FileStats]
    total: Counts


def stats_of(
    protocol: Protocol, files: list[FileStats], together: Totals, expression: str | None = None
) -> Stats:
    """The statistics of captures; `together` are the totals of all of them."""
    duration = sum(file.counts.duration for file in files)
    return Stats(
        grammar=Grammar(protocol.name, protocol.version, protocol.sha256),
        filter=expression,
        files=files,
        total=_counts(together, duration, _mean_load(files, duration)),
    )


def file_stats(capture: Capture, totals: Totals, line: LineSettings) -> FileStats:
    """The statistics of one capture with these totals, recorded on such a line."""
    first, last = totals.first, totals.last
    duration = ((last or 0) - (first or 0)) / SECOND
    load = None
    if duration:
        share = line.byte_time / SECOND / duration  # of one byte
        load = Load(totals.host_bytes * share, totals.device_bytes * share)
    return FileStats(
        path=str(capture.path),
        unfinished=capture.unfinished,
        damage=capture.damage,
        line=str(line),
        first=None if first is None else first / SECOND,
        last=None if last is None else last / SECOND,
        counts=_counts(totals, duration, load),
        rates=_rates(totals.rates),
    )


def _mean_load(files: list[FileStats], duration: float) -> Load | None:
    if not duration:
        return None
    host = device = 0.0
    for file in files:
        if load := file.counts.load:
            host += load.host * file.counts.duration
            device += load.device * file.counts.duration
    return Load(host / duration, device / duration)


def _rates(rates: Rates) -> RateCounts | None:
    counts = [rates.series(name) for name in ("frames", "faults", "host_bytes", "device_bytes")]
    if not counts[0]:
        return None
    return RateCounts(rates.start / SECOND, rates.width / SECOND, *counts)


def _counts(totals: Totals, duration: float, load: Load | None) -> Counts:
    instructions = totals.instructions()
    directions = {"host": "host", "device": "device", "neither": ""}
    return Counts(
        duration=duration,
        moving=totals.moving / SECOND,
        load=load,
        host_bytes=totals.host_bytes,
        device_bytes=totals.device_bytes,
        frames=totals.frames,
        truncated=totals.kinds["truncated"],
        garbage=totals.kinds["garbage"],
        peak=totals.peak,
        instructions={name: found.frames for name, found in instructions.items()},
        expected=totals.expected(),
        responses=totals.responses(),
        agreeing=totals.agreeing,
        disagreeing=totals.disagreeing,
        anomalies=dict(totals.faults.most_common()),
        by_direction={
            name: dict(totals.faults_of(side).most_common()) for name, side in directions.items()
        },
        by_instruction={
            name: InstructionCounts(
                found.frames, found.responses, found.faults, _latency(found.latencies)
            )
            for name, found in instructions.items()
        },
        latency=_latency(totals.latencies.spread()),
        latency_bins=[
            LatencyBin(start / SECOND, stop / SECOND, amount)
            for start, stop, amount in totals.latencies.histogram()
        ],
    )


def _latency(spread: Spread | None) -> Latency | None:
    if spread is None:
        return None
    return Latency(
        spread.count,
        spread.shortest / SECOND,
        spread.median / SECOND,
        spread.ninety_fifth / SECOND,
        spread.ninety_ninth / SECOND,
        spread.longest / SECOND,
    )
