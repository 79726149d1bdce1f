"""The figures of a recording in few words: frames, rates, load, latencies, faults by kind."""

from __future__ import annotations

from collections.abc import Iterator

from rich.text import Text

from bilprov.analyzer.output.statistics import Rates
from bilprov.analyzer.screen.signs import Signs
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.text import printable, quantity


def figures(totals: Totals, live: Rates | None, byte_time: int, signs: Signs) -> list[Text]:
    """The lines, each a label and what it says.

    Rates are those of the last two seconds where they are those of a `live` line, else the mean
    over the recording. `byte_time` is ns a byte on the line.
    """
    return [
        Text.assemble((f"{label:<8}", "dim"), words)
        for label, words in _rows(totals, live, byte_time, signs)
    ]


def _rows(
    totals: Totals, live: Rates | None, byte_time: int, signs: Signs
) -> Iterator[tuple[str, str]]:
    seconds = ((totals.last or 0) - (totals.first or 0)) / 1e9
    sides = (totals.host_bytes, totals.device_bytes)
    rates = [size / seconds if seconds else 0.0 for size in sides]
    frames = totals.frames / seconds if seconds else 0.0
    if live:
        rates, frames = list(live.bytes), live.frames
    yield "frames", f"{totals.frames:,} {signs.to_device}"
    yield "answers", f"{totals.device_bytes:,} {signs.to_host}"
    if totals.disagreeing:
        yield "wrong", f"{totals.disagreeing:,}"
    yield "rate", f"{quantity(round(frames), 'frame')}/s"
    for side, rate in zip(("host", "device"), rates, strict=True):
        yield side, f"{rate:,.0f} B/s {rate * byte_time / 1e9:.0%}"
    spread = totals.latencies.spread()
    if spread is None:
        yield "latency", "none yet"
    else:
        yield "latency", f"{_ms(spread.median)} ms median"
        yield "", f"{_ms(spread.ninety_fifth)} 95 %, {_ms(spread.longest)} max"
    yield "faults", f"{totals.faults.total():,}"
    for kind, count in totals.faults.most_common(6):
        yield "", f"{count:,} {printable(kind)}"


def _ms(t: int) -> str:
    ms = t / 1e6
    return f"{ms:.3g}" if abs(ms) < 100 else f"{ms:.0f}"
