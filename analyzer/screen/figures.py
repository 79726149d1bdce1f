"""The figures of a recording in few lines: load of the line, latencies, whose the faults are."""

from __future__ import annotations

from rich.text import Text

from bilprov.analyzer.output.statistics import Rates
from bilprov.analyzer.output.stats_tables import spark
from bilprov.analyzer.screen.signs import DEVICE_FAULT, HOST_FAULT, LINE_FAULT
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.text import printable, quantity

_SIDES = {"host": HOST_FAULT, "device": DEVICE_FAULT, "": LINE_FAULT}
_LATE = 9  # columns of a latency, with a space before it
_KINDS = 4  # kinds of faults of each side that are named


def figures(totals: Totals, live: Rates | None, byte_time: int, width: int) -> list[Text]:
    """The lines. Rates are those of the last two seconds where they are those of a `live` line,
    else the mean over the recording. `byte_time` is ns a byte on the line.
    """
    seconds = ((totals.last or 0) - (totals.first or 0)) / 1e9 or 1.0
    rates = live or Rates(
        totals.frames / seconds, (totals.host_bytes / seconds, totals.device_bytes / seconds)
    )
    load = max(rates.bytes) * byte_time / 1e9
    lines = [
        Text(spark(totals.rates.series("frames"), width)),
        Text(quantity(totals.frames, "frame")),
        Text(quantity(totals.answers, "answer")),
        Text(f"{rates.frames:,.0f} frames/s, {load:.0%} full"),
    ]
    spread = totals.latencies.spread()
    if spread:
        lines.append(Text(f"latency {_ms(spread.median)} ms"))
        lines.append(Text(f"p95 {_ms(spread.p95)}, max {_ms(spread.max)} ms"))
    for side, look in _SIDES.items():
        kinds = totals.faults_of(side)
        if kinds:
            lines.append(Text())
            name = side or "line"
            lines.append(Text(f"{look.sign} {kinds.total():,} from the {name}", look.style))
        for kind, count in kinds.most_common(_KINDS):
            lines.append(Text(f"  {printable(kind)}: {count:,}", "dim"))
    lines.append(Text())
    said = {name: said for name, said in totals.instructions().items() if said.frames}
    digits = max((len(f"{one.frames:,}") for one in said.values()), default=0)
    for name, one in said.items():
        late = f"{_ms(one.latencies.median)} ms" if one.latencies else ""
        line = Text(printable(name), "dim")
        line.truncate(width - digits - _LATE - 1, overflow="ellipsis", pad=True)
        lines.append(line.append(f" {one.frames:>{digits},}{late:>{_LATE}}"))
    return lines


def _ms(t: int) -> str:
    ms = t / 1e6
    return f"{ms:.3g}" if abs(ms) < 100 else f"{ms:.0f}"
