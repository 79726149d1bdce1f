"""The page of `bilprov plot`: the picture over time, latencies, and a list of the anomalies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from bilprov.analyzer.html.markup import Safe, bar, filled, html_page, joined, json_block, tag
from bilprov.analyzer.output.capture_stats import Json
from bilprov.analyzer.totals.timeline import Mark, Timeline, numbers_of, word_of
from bilprov.captures.reader import Capture
from bilprov.captures.text import quantity
from bilprov.spec.protocol import Protocol

_ASSETS = Path(__file__).parent / "assets"
SECOND = 1e9  # ns
_SHARE = 10  # an idle time is folded if it is longer than this part of the rest of the recording

_RANGES = ("seen", "high", "count")  # what exact rows have once
_BUTTONS = {
    "in": "Zoom in",
    "out": "Zoom out",
    "all": "Show all",
    "previous": "Previous anomaly",
    "next": "Next anomaly",
}


def plot_page(
    capture: Capture, protocol: Protocol, timeline: Timeline, stats: Json, kit: str
) -> str:
    """The page about one capture: its timeline, and the numbers of the same recording.

    `kit` is the version of the code that makes it.
    """
    style = (_ASSETS / "plot.css").read_text(encoding="utf-8")
    script = (_ASSETS / "plot.js").read_text(encoding="utf-8")
    name = capture.path.name
    notes = [f"Part of the file is damaged and left out: {why}" for why in stats["damage"]]
    if stats["unfinished"]:
        notes.insert(0, "The recording was never finished: everything intact is shown.")
    word = word_of(protocol)
    shown = [*([word] if word else []), *numbers_of(protocol)]
    values = {one: one for one in ("time", *shown)}
    values |= {"latency": "last latency", "anomaly": "anomaly"}
    body = filled(
        _ASSETS / "plot.html",
        name=name,
        facts=joined(
            tag("div", tag("dt", fact), tag("dd", value))
            for fact, value in _facts(capture, protocol, stats, kit).items()
        ),
        notes=joined(tag("p", note, class_="note") for note in notes),
        buttons=joined(
            tag("button", said, type="button", class_="chip", data_do=do)
            for do, said in _BUTTONS.items()
        ),
        values=joined(
            tag("div", tag("dt", said), tag("dd", "", data_of=one), class_=f"of-{one}")
            for one, said in values.items()
        ),
        label=f"{', '.join([*shown, 'anomalies'])} and latency over time".capitalize(),
        folded=joined(tag("p", said, class_="dim small") for said in _folded(timeline)),
        reduced=_reduced(timeline),
        latency=_latencies(stats["counts"]),
        anomalies=_anomalies(*timeline.marks(), stats["counts"]),
        data=json_block("data", plot_data(protocol, timeline)),
    )
    return html_page(f"{name} · bilprov plot", body, style=style, script=script)


def plot_data(protocol: Protocol, timeline: Timeline) -> dict[str, Any]:
    """What the page's script draws. Times are in ns; those of a list each from the one before."""
    (states, states_step), (latencies, step) = timeline.states(), timeline.latencies()
    marks, _ = timeline.marks()
    word, variables = word_of(protocol), protocol.variables
    words = variables[word].words if word else ()
    return {
        "begin": timeline.begin,
        "end": timeline.end,
        "folds": [(first, last, _long(last - first)) for first, last in _folds(timeline)],
        "word": word,
        "motions": [one.replace("_", " ") for one in words],
        "bounds": {n: (variables[n].low, variables[n].high) for n in numbers_of(protocol)},
        "states": _columns(states, states_step),
        "latencies": _columns(latencies, step),
        "marks": {"t": _deltas([mark.t for mark in marks]), "n": [mark.amount for mark in marks]},
        "steps": [states_step, step],
    }


def _folds(timeline: Timeline) -> list[tuple[int, int]]:
    """The idle times that the axis leaves out: from when to when (ns)."""
    idle = timeline.idle()
    rest = timeline.end - timeline.begin - sum(last - first for first, last in idle)
    return [(first, last) for first, last in idle if last - first > rest / _SHARE]


def _columns(columns: dict[str, Any], step: int) -> dict[str, Any]:
    """The columns of a timeline; exact rows (`step` is 0) have one value each."""
    found = {**columns, "t": _deltas(columns["t"])}
    if not step:
        found = {name: value for name, value in found.items() if name not in _RANGES}
        for name, value in found.items():
            if isinstance(value, dict):
                found[name] = {"last": value["last"]}
    return found


def _deltas(times: list[int]) -> list[int]:
    return [*times[:1], *(after - before for before, after in pairwise(times))]


def _facts(capture: Capture, protocol: Protocol, stats: Json, kit: str) -> dict[str, object]:
    """What is known of the recording as a whole, by name."""
    counts = stats["counts"]
    load, share = counts["load"], counts["moving"] / (counts["duration"] or 1)
    cut = f", {counts['truncated']:,} of them truncated" if counts["truncated"] else ""
    used = f", host uses {load['host']:.1%} of it, device {load['device']:.1%}" if load else ""
    moving = f"{_span(counts['moving'])} ({share:.0%})" if counts["duration"] else _span(0)
    sha = tag("code", protocol.sha256[:12], title=protocol.sha256)
    return {
        "recorded": f"{datetime.fromtimestamp(capture.start // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC",
        "span of traffic": _span(counts["duration"]),
        **({"moving": moving} if protocol.at_rest else {}),
        "frames": f"{counts['frames']:,}{cut}",
        "answers": f"{counts['agreeing']:,} as expected, {counts['disagreeing']:,} not",
        "anomalies": f"{sum(counts['anomalies'].values()):,}",
        "line": f"{stats['line']}{used}",
        "grammar": tag("span", f"{protocol.name} {protocol.version} ", sha),
        "bilprov": kit,
    }


def _folded(timeline: Timeline) -> Iterator[str]:
    """What the time axis leaves out."""
    if folds := _folds(timeline):
        amount = _long(sum(last - first for first, last in folds))
        stretches = quantity(len(folds), "stretch", "stretches")
        yield f"{stretches} without traffic, {amount} in all, folded on the time axis."


def _reduced(timeline: Timeline) -> str:
    """What of the recording is not in the page."""
    steps = {"states": timeline.states()[1], "latencies": timeline.latencies()[1]}
    said = [
        f"{name} are reduced to the lowest and the highest in each {_span(step / SECOND)}"
        for name, step in steps.items()
        if step
    ]
    _, step = timeline.marks()
    if step:
        said.append(f"of the anomalies the first in each {_span(step / SECOND)} is described")
    if not said:
        return "Every change of the state, every latency and every anomaly is in this page."
    return (
        f"The recording is long: {'; '.join(said)}. Zooming in further shows no more; bilprov "
        "replay --start shows every frame."
    )


def _latencies(counts: Json) -> Safe:
    if not counts["latency"]:
        return tag("p", "No answer was paired with its instruction.", class_="dim")
    most = max(one["count"] for one in counts["latency_bins"])
    bins = [
        tag(
            "tr",
            tag("th", f"{_span(one['least'])} to {_span(one['below'])}", scope="row"),
            tag("td", f"{one['count']:,}", class_="number"),
            tag("td", bar(100, [("0", f"{one['count'] / most * 100:.2f}", "done")])),
        )
        for one in counts["latency_bins"]
    ]
    found = {"all": counts, **counts["by_instruction"]}
    spreads = [_latency(name, one["latency"]) for name, one in found.items() if one["latency"]]
    heads = ("instruction", "answers", "min", "median", "95 %", "99 %", "max")
    label = "Latency of each instruction"
    said = tag("p", "From the last byte of an instruction to its answer.", class_="dim")
    histogram = _table("Histogram", ("latency", "answers", ""), bins, class_="histogram")
    each = _scrolled(label, _table(label, heads, spreads, class_="each"))
    return joined([said, tag("div", histogram, each, class_="two")])


def _table(caption: str, heads: tuple[str, ...], rows: Iterable[Safe], **more: object) -> Safe:
    """A table whose caption is only read aloud."""
    return tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", tag("tr", *(tag("th", head, scope="col") for head in heads))),
        tag("tbody", *rows),
        **more,
    )


def _scrolled(label: str, table: Safe) -> Safe:
    """A table that may be wider or longer than its place."""
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label=label)


def _latency(name: str, spread: Json) -> Safe:
    count, *times = spread.values()
    cells = [f"{count:,}", *map(_span, times)]
    return tag(
        "tr", tag("th", name, scope="row"), *(tag("td", cell, class_="number") for cell in cells)
    )


def _anomalies(marks: list[Mark], step: int, counts: Json) -> Safe:
    kinds = ", ".join(f"{kind}: {count:,}" for kind, count in counts["anomalies"].items())
    first = f" Listed is the first in each {_span(step / SECOND)}." if step else ""
    said = tag("p", f"{kinds}." if kinds else "None.", first)
    if not marks:
        return said
    rows = (
        tag(
            "tr",
            tag("td", tag("a", f"{mark.t / SECOND:.6f} s", href=f"#t={mark.t}"), class_="number"),
            tag("td", mark.kind),
            tag("td", mark.reason, *_more(mark)),
        )
        for mark in marks
    )
    table = _table("Anomalies in the order of their times", ("time", "kind", "reason"), rows)
    return joined([said, _scrolled("Anomalies", table)])


def _more(mark: Mark) -> Iterator[Safe]:
    """How many more there are at a mark."""
    if mark.amount > 1:
        yield tag("span", f" and {mark.amount - 1:,} more", class_="dim")


def _long(ns: int) -> str:
    """A long duration in its two largest units, rounded down: `7 h 42 min`."""
    seconds = ns // 10**9
    for unit, size, less, part in (("d", 86400, "h", 3600), ("h", 3600, "min", 60)):
        if seconds >= size:
            return f"{seconds // size:,} {unit} {seconds % size // part} {less}"
    minutes = f"{seconds // 60} min " if seconds >= 60 else ""
    return f"{minutes}{seconds % 60} s"


def _span(seconds: float) -> str:
    """A duration in the unit that fits it, with up to four digits."""
    for factor, unit in ((1, "s"), (1e3, "ms")):
        if abs(seconds) * factor >= 1:
            return f"{seconds * factor:.4g} {unit}" if seconds < 1e4 else f"{seconds:,.0f} s"
    return f"{seconds * 1e6:.4g} µs" if seconds else "0 s"
