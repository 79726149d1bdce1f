"""The statistics that `bilprov stats` shows of captures: as values, as JSON and as tables.

The JSON of `--json` is one object. Times and durations are in seconds:

- `grammar`: `name`, `version` and `sha256` of the grammar by which the bytes were decoded.
- `files`: for each capture, in the order in which they were named:
  - `path`; `unfinished` (the recording was cut short) and `damage` (a sentence for each part of the
    file that is left out).
  - `first`, `last`: when the first and the last byte came, from the start of the recording; null
    where there is no byte.
  - `counts`: see below.
- `total`: the counts of all files together.

Counts have these keys:

- `duration`: from the first byte to the last; in `total` the sum.
- `host_bytes`, `device_bytes`: bytes on the line.
- `frames`: host frames, of which `truncated` were cut short; `garbage` counts runs of host bytes
  that belong to no frame.
- `peak`: the largest number of frames that ended in one second, counted from the start.
- `instructions`: frames by the name of the instruction, and `unused 9` for an ID that has none.
- `expected`: frames by the response that a conforming device gives them.
- `responses`: bytes of the device by the name of the response, and `unused 9` for other codes.
- `agreeing`, `disagreeing`: answers that are the expected one; others, and all unused codes.
- `anomalies`: by kind, as `faults` of the JSON lines names them.
- `latency`: null where nothing is paired, else `count`, `min`, `median`, `p95`, `p99`, `max`: from
  the last byte of a frame to its answer; `min` and `max` are exact, the rest rounded down to 1 us.

Instructions and responses of the grammar are there even where the count is 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec
from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, table
from bilprov.captures.reader import Capture
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.columns.latencies import Spread
    from bilprov.analyzer.columns.totals import Totals

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


class Counts(msgspec.Struct, frozen=True, kw_only=True):
    """The counts of one capture, or of several; the module's docstring explains the keys."""

    duration: float
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
    latency: Latency | None


class FileStats(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of one capture; the module's docstring explains the keys."""

    path: str
    unfinished: bool
    damage: tuple[str, ...]
    first: float | None
    last: float | None
    counts: Counts


class Stats(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of some captures; the module's docstring explains the keys."""

    grammar: Grammar
    files: list[FileStats]
    total: Counts


def stats_of(protocol: Protocol, files: list[FileStats], together: Totals) -> Stats:
    """The statistics of captures; `together` are the totals of all of them."""
    return Stats(
        grammar=Grammar(protocol.name, protocol.version, protocol.sha256),
        files=files,
        total=_counts(together, sum(file.counts.duration for file in files)),
    )


def file_stats(capture: Capture, totals: Totals) -> FileStats:
    """The statistics of one capture with these totals."""
    first, last = totals.first, totals.last
    return FileStats(
        path=str(capture.path),
        unfinished=capture.unfinished,
        damage=capture.damage,
        first=None if first is None else first / SECOND,
        last=None if last is None else last / SECOND,
        counts=_counts(totals, ((last or 0) - (first or 0)) / SECOND),
    )


def _counts(totals: Totals, duration: float) -> Counts:
    spread = totals.latencies
    return Counts(
        duration=duration,
        host_bytes=totals.host_bytes,
        device_bytes=totals.device_bytes,
        frames=totals.frames,
        truncated=totals.kinds["truncated"],
        garbage=totals.kinds["garbage"],
        peak=totals.peak,
        instructions=totals.instructions(),
        expected=totals.expected(),
        responses=totals.responses(),
        agreeing=totals.agreeing,
        disagreeing=totals.disagreeing,
        anomalies=dict(totals.faults.most_common()),
        latency=_latency(spread) if spread else None,
    )


def _latency(spread: Spread) -> Latency:
    return Latency(
        spread.count,
        spread.shortest / SECOND,
        spread.median / SECOND,
        spread.ninety_fifth / SECOND,
        spread.ninety_ninth / SECOND,
        spread.longest / SECOND,
    )


def drawn(stats: Stats) -> Iterator[RenderableType]:
    """Yield the parts to print; text from the files is escaped."""
    for number, file in enumerate(stats.files):
        if number:
            yield Text()
        yield from _part(printable(file.path), file.counts)
    if len(stats.files) > 1:
        yield Text()
        yield from _part(f"{len(stats.files)} captures together", stats.total)


def _part(title: str, counts: Counts) -> Iterator[RenderableType]:
    yield heading(title)
    yield facts(_about(counts))
    yield from _table("instruction", counts.instructions)
    yield from _table("expected response", counts.expected)
    yield from _table("response", counts.responses)
    yield from _table("anomaly", counts.anomalies)


def _about(counts: Counts) -> Iterator[tuple[str, str]]:
    yield "duration", f"{counts.duration:.3f} s"
    yield "host", f"{counts.host_bytes:,} bytes, {_frames(counts)}"
    yield "device", f"{counts.device_bytes:,} bytes"
    if counts.frames:
        rate = f"{counts.frames / counts.duration:,.0f} a second, " if counts.duration else ""
        yield "frames", f"{rate}{counts.peak:,} in the busiest second"
    if counts.agreeing or counts.disagreeing:
        yield "answers", f"{counts.agreeing:,} as expected, {counts.disagreeing:,} not"
    latency = counts.latency
    if latency:
        named = {"min": latency.min, "median": latency.median, "95 %": latency.p95}
        named |= {"99 %": latency.p99, "max": latency.max}
        said = (f"{name} {value * 1000:.3f} ms" for name, value in named.items())
        yield "latency", ", ".join(said)


def _frames(counts: Counts) -> str:
    said = f"{counts.frames:,} frames"
    if counts.truncated:
        said += f", {counts.truncated:,} of them truncated"
    if counts.garbage:
        said += f", {counts.garbage:,} pieces of garbage"
    return said


def _table(name: str, counts: Mapping[str, int]) -> Iterator[RenderableType]:
    rows = [(printable(kind), f"{count:,}") for kind, count in counts.items() if count]
    if rows:
        yield Text()
        yield table((name, "count"), rows, right="count")
