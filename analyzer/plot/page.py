"""The page of `bilprov plot`: the picture over time, latencies, and a list of the anomalies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from bilprov.analyzer.html.markup import Safe, bar, html_page, joined, json_block, tag
from bilprov.analyzer.output.capture_stats import Json
from bilprov.analyzer.totals.timeline import Mark, Timeline, numbers_of, word_of
from bilprov.captures.reader import Capture
from bilprov.captures.text import quantity
from bilprov.spec.protocol import Protocol

_ASSETS = Path(__file__).parent / "assets"
SECOND = 1e9  # ns
_SHARE = 10  # an idle time is folded if it is longer than this part of the rest of the recording

_RANGES = ("seen", "high", "count")  # what exact rows have once
_KEYS = (
    "Wheel, pinch or + and - zoom; drag or Shift with the arrows moves; the arrows move the line "
    "at which values are read; n and N go to the next and the previous anomaly; 0 shows all again."
)


def plot_page(
    capture: Capture, protocol: Protocol, timeline: Timeline, stats: Json, kit: str
) -> str:
    """The page about one capture: its timeline, and the numbers of the same recording.

    `kit` is the version of the code that makes it.
    """
    style = (_ASSETS / "plot.css").read_text(encoding="utf-8")
    script = (_ASSETS / "plot.js").read_text(encoding="utf-8")
    marks, step = timeline.marks()
    name = capture.path.name
    body = joined(
        [
            tag(
                "header",
                tag("p", "bilprov", tag("span", " plot"), class_="brand"),
                tag("h1", tag("span", name, class_="device")),
            ),
            tag(
                "main",
                _facts(capture, protocol, stats, kit),
                _picture(protocol, timeline),
                _latencies(stats["counts"]),
                _anomalies(marks, step, stats["counts"]),
            ),
            json_block("data", plot_data(protocol, timeline)),
        ]
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


def _facts(capture: Capture, protocol: Protocol, stats: Json, kit: str) -> Safe:
    counts = stats["counts"]
    told: dict[str, object] = {
        "recorded": f"{datetime.fromtimestamp(capture.start // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    }
    told["span of traffic"] = _span(counts["duration"])
    moving = f" ({counts['moving'] / counts['duration']:.0%})" if counts["duration"] else ""
    if protocol.at_rest:
        told["moving"] = _span(counts["moving"]) + moving
    cut = f", {counts['truncated']:,} of them truncated" if counts["truncated"] else ""
    told["frames"] = f"{counts['frames']:,}{cut}"
    told["answers"] = f"{counts['agreeing']:,} as expected, {counts['disagreeing']:,} not"
    told["anomalies"] = f"{sum(counts['anomalies'].values()):,}"
    load = counts["load"]
    used = f", host uses {load['host']:.1%} of it, device {load['device']:.1%}" if load else ""
    told["line"] = f"{stats['line']}{used}"
    sha = tag("code", protocol.sha256[:12], title=protocol.sha256)
    told["grammar"] = tag("span", f"{protocol.name} {protocol.version} ", sha)
    told["bilprov"] = kit
    facts = [tag("div", tag("dt", name), tag("dd", value)) for name, value in told.items()]
    notes = [f"Part of the file is damaged and left out: {why}" for why in stats["damage"]]
    if stats["unfinished"]:
        notes.insert(0, "The recording was never finished: everything intact is shown.")
    return tag(
        "section",
        tag("dl", *facts, class_="grid"),
        *(tag("p", note, class_="note") for note in notes),
        id="facts",
        aria_label="Recording",
    )


def _picture(protocol: Protocol, timeline: Timeline) -> Safe:
    buttons = {
        "in": "Zoom in",
        "out": "Zoom out",
        "all": "Show all",
        "previous": "Previous anomaly",
        "next": "Next anomaly",
    }
    tools = (
        tag("button", said, type="button", class_="chip", data_do=do)
        for do, said in buttons.items()
    )
    word = word_of(protocol)
    shown = [*([word] if word else []), *numbers_of(protocol)]
    names = {name: name for name in ("time", *shown)}
    names |= {"latency": "last latency", "anomaly": "anomaly"}
    values = (
        tag("div", tag("dt", said), tag("dd", "", data_of=name), class_=f"of-{name}")
        for name, said in names.items()
    )
    return tag(
        "section",
        tag("h2", "Over time"),
        tag("noscript", tag("p", "The picture needs JavaScript; the tables below do not.")),
        tag("div", *tools, id="tools", role="group", aria_label="The picture", hidden=True),
        tag("dl", *values, id="readout", role="status", hidden=True),
        tag(
            "canvas",
            id="plot",
            tabindex=0,
            role="application",
            aria_label=f"{', '.join([*shown, 'anomalies'])} and latency over time".capitalize(),
            aria_describedby="keys",
        ),
        tag("canvas", id="map", aria_hidden="true"),
        tag("p", _KEYS, id="keys", class_="dim small"),
        *(tag("p", said, class_="dim small") for said in _folded(timeline)),
        tag("p", _reduced(timeline), id="reduced", class_="dim small"),
        id="time",
    )


def _folded(timeline: Timeline) -> Iterator[str]:
    """What the time axis leaves out."""
    if folds := _folds(timeline):
        amount = _long(sum(last - first for first, last in folds))
        stretches = quantity(len(folds), "stretch", "stretches")
        yield f"{stretches} without traffic, {amount} in all, folded on the time axis."


def _reduced(timeline: Timeline) -> str:
    """What of the recording is not in the page."""
    said = [
        f"{name} are reduced to the lowest and the highest in each {_span(step / SECOND)}"
        for name, step in (
            ("states", timeline.states()[1]),
            ("latencies", timeline.latencies()[1]),
        )
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
        empty = tag("p", "No answer was paired with its instruction.", class_="dim")
        return tag("section", tag("h2", "Latency"), empty, id="latency")
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
    each = [("all", counts["latency"])]
    each += [
        (name, found["latency"])
        for name, found in counts["by_instruction"].items()
        if found["latency"]
    ]
    heads = ("instruction", "answers", "min", "median", "95 %", "99 %", "max")
    spreads = [_latency(name, spread) for name, spread in each]
    label = "Latency of each instruction"
    return tag(
        "section",
        tag("h2", "Latency"),
        tag("p", "From the last byte of an instruction to its answer.", class_="dim"),
        tag(
            "div",
            _table("Histogram", ("latency", "answers", ""), bins, class_="histogram"),
            _scrolled(label, _table(label, heads, spreads, class_="each")),
            class_="two",
        ),
        id="latency",
    )


def _table(caption: str, heads: tuple[str, ...], rows: Iterable[Safe], **more: object) -> Safe:
    """A table whose caption is only read aloud."""
    return tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", _row("th", heads, scope="col")),
        tag("tbody", *rows),
        **more,
    )


def _scrolled(label: str, table: Safe) -> Safe:
    """A table that may be wider or longer than its place."""
    return tag("div", table, class_="scroll", tabindex=0, role="region", aria_label=label)


def _row(cell: str, texts: tuple[str, ...], **attributes: object) -> Safe:
    return tag("tr", *(tag(cell, text, **attributes) for text in texts))


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
        return tag("section", tag("h2", "Anomalies"), said, id="anomalies")
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
    scrolled = _scrolled("Anomalies", table)
    return tag("section", tag("h2", "Anomalies"), said, scrolled, id="anomalies")


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
