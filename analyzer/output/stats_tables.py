"""Shows the statistics of captures as tables with sparklines and a histogram, 80 columns wide."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.capture_stats import Json
from bilprov.analyzer.output.console import facts, heading, table
from bilprov.captures.text import printable, quantity

_STEPS = "▁▂▃▄▅▆▇█"
"""The signs of a sparkline from the lowest to the highest, without one for 0."""
_FILLS = "▏▎▍▌▋▊▉█"
"""The parts of a bar's last cell from the smallest to a full one."""


def spark(values: Sequence[float], width: int) -> str:
    """Values side by side, the largest as high as can be; a mean of several for want of room.

    What is 0 is blank, and what is not is never blank.
    """
    columns = means(values, width)
    most = max(columns, default=0)
    last = len(_STEPS) - 1
    return "".join(
        _STEPS[min(int(value / most * len(_STEPS)), last)] if value > 0 else " "
        for value in columns
    )


def bar(share: float, width: int) -> str:
    """A bar as long as a share (0 to 1) of the width; what is not 0 is never blank."""
    full, rest = divmod(max(round(share * width * 8), int(share > 0)), 8)
    return _FILLS[-1] * full + (_FILLS[rest - 1] if rest else "")


def means(values: Sequence[float], most: int) -> list[float]:
    """The values, or where there are more than `most` the means of neighbours."""
    count = len(values)
    if count <= most:
        return list(values)
    bounds = [place * count // most for place in range(most + 1)]
    pieces = (values[low:high] for low, high in pairwise(bounds))
    return [sum(piece) / len(piece) for piece in pieces]


_SPARK = 36  # columns of a sparkline
_BAR = 36  # columns of the longest bar
FEWEST = 4  # counts by time that are worth a sparkline


def drawn(stats: Json, *, moves: bool) -> Iterator[RenderableType]:
    """Yield the parts to print; text from the files is escaped."""
    if stats["filter"] is not None:
        yield Text(f"Only what passes {printable(stats['filter'])} is counted.")
        yield Text()
    for number, file in enumerate(stats["files"]):
        if number:
            yield Text()
        yield from _part(printable(file["path"]), file["counts"], file, moves=moves)
    if len(stats["files"]) > 1:
        yield Text()
        together = f"{len(stats['files'])} captures together"
        yield from _part(together, stats["total"], None, moves=moves)


def _part(title: str, counts: Json, file: Json | None, *, moves: bool) -> Iterator[RenderableType]:
    yield heading(title)
    yield facts(_about(counts, file, moves=moves))
    if file and file["rates"] and len(file["rates"]["frames"]) >= FEWEST:
        yield from _rates(counts, file["rates"])
    yield from _instructions(counts)
    yield from _responses(counts)
    yield from _anomalies(counts)
    yield from _histogram(counts)


def _about(counts: Json, file: Json | None, *, moves: bool) -> Iterator[tuple[str, str]]:
    share = f" ({_share(counts['moving'] / counts['duration'])})" if counts["duration"] else ""
    moving = f", moving for {counts['moving']:.3f} s{share}" if moves else ""
    yield "span of traffic", f"{counts['duration']:.3f} s{moving}"
    yield "host", f"{quantity(counts['host_bytes'], 'byte')}, {_frames(counts)}"
    yield "device", quantity(counts["device_bytes"], "byte")
    if counts["load"]:
        line = f"{file['line']}, " if file else ""
        load = f"host {_share(counts['load']['host'])}, device {_share(counts['load']['device'])}"
        yield "line", f"{line}load: {load}"
    if counts["frames"]:
        seconds = counts["duration"]
        rate = f"{counts['frames'] / seconds:,.0f} a second, " if seconds else ""
        yield "frames", f"{rate}{counts['peak']:,} in the busiest second"
    if counts["agreeing"] or counts["disagreeing"]:
        yield "answers", f"{counts['agreeing']:,} as expected, {counts['disagreeing']:,} not"
    if counts["latency"]:
        median, p95, p99, longest = _percentiles(counts["latency"])
        least = _ms(counts["latency"]["min"])
        yield "latency", f"min {least} ms, median {median}, 95 % {p95}, 99 % {p99}, max {longest}"


def _frames(counts: Json) -> str:
    said = quantity(counts["frames"], "frame")
    if counts["truncated"]:
        said += f", {counts['truncated']:,} of them truncated"
    if counts["garbage"]:
        said += f", {quantity(counts['garbage'], 'piece of garbage', 'pieces of garbage')}"
    return said


def _rates(counts: Json, rates: Json) -> Iterator[RenderableType]:
    """How much there was a second, from the first second to the last."""
    names = ("frames", "anomalies", "host bytes", "device bytes")
    rows = []
    for name, key in zip(names, ("frames", "faults", "host_bytes", "device_bytes"), strict=True):
        mean = sum(rates[key]) / counts["duration"] if counts["duration"] else 0
        peak = _number(max(rates[key]) / rates["step"])
        if peak != "0":
            rows.append((name, spark(rates[key], _SPARK), _number(mean), peak))
    yield Text()
    yield table(("a second", "from begin to end", "mean", "peak"), rows, right="mean peak")


def _instructions(counts: Json) -> Iterator[RenderableType]:
    rows = []
    for name, found in counts["by_instruction"].items():
        if found["frames"]:
            answers, odd = sum(found["responses"].values()), sum(found["anomalies"].values())
            latency = _percentiles(found["latency"]) if found["latency"] else ("",) * 4
            rows.append((name, *map(_count, (found["frames"], answers, odd)), *latency))
    columns = ("instruction", "frames", "answers", "odd", "median/ms", "p95", "p99", "max")
    yield from _table(columns, rows)


def _responses(counts: Json) -> Iterator[RenderableType]:
    names = dict.fromkeys([*counts["expected"], *counts["responses"]])
    pairs = {
        name: (counts["expected"].get(name, 0), counts["responses"].get(name, 0)) for name in names
    }
    rows = [(name, *map(_count, pair)) for name, pair in pairs.items() if any(pair)]
    yield from _table(("response", "expected", "given"), rows)


def _anomalies(counts: Json) -> Iterator[RenderableType]:
    sides = counts["by_direction"]
    rows = []
    for kind, count in counts["anomalies"].items():
        found = [count, *(by.get(kind, 0) for by in sides.values())]
        rows.append((kind, *map(_count, found)))
    yield from _table(("anomaly", "count", *sides), rows)


def _histogram(counts: Json) -> Iterator[RenderableType]:
    bins = counts["latency_bins"]
    most = max((one["count"] for one in bins), default=0)
    if not most:
        return
    width = bins[0]["below"] - bins[0]["least"]
    decimals = next(n for n in range(7) if round(width * 1000, n) == round(width * 1000, 7))
    rows = []
    for one in bins:
        least, below = (f"{edge * 1000:.{decimals}f}" for edge in (one["least"], one["below"]))
        rows.append((least, below, f"{one['count']:,}", bar(one["count"] / most, _BAR)))
    yield Text()
    yield table(("from/ms", "to/ms", "answers", "latency"), rows, right="from/ms to/ms answers")


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[RenderableType]:
    """A table of a name and numbers, after an empty line; nothing where there are no rows."""
    if rows:
        yield Text()
        yield table(columns, rows, right=" ".join(columns[1:]))


def _percentiles(latency: Json) -> list[str]:
    return [_ms(latency[name]) for name in ("median", "p95", "p99", "max")]


def _ms(seconds: float) -> str:
    """Seconds in ms, in at most six characters for any latency of less than 17 minutes."""
    ms = seconds * 1000
    return f"{ms:.3f}" if abs(ms) < 10 else f"{ms:.2f}" if abs(ms) < 100 else f"{ms:.1f}"


def _share(load: float) -> str:
    return f"{load * 100:,.0f} %" if load >= 0.1 else f"{load * 100:.2g} %"


def _count(count: int) -> str:
    return f"{count:,}" if count else ""


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 or value == round(value) else f"{value:.2f}"
