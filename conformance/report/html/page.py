"""Writes reports as one self-contained HTML page, which loads nothing from elsewhere.

It begins with the causes: what to change, each with the line that shows it and what then passed.
At its end are tables about each run: device, options, profile and coverage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

from msgspec import structs

from bilprov.analyzer.html.markup import Safe, bar, filled, html_page, joined, json_block, tag, text
from bilprov.captures.schemas import MS
from bilprov.captures.text import quantity
from bilprov.conformance.oracle.judge import code_words
from bilprov.conformance.oracle.profile import default_of
from bilprov.conformance.oracle.verdicts import AXES, CaseResult, Cause, Verdict, WireEvent
from bilprov.conformance.report import run_report
from bilprov.conformance.report.grouping import Row, by_group, names, rows, tally
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import READINGS

# -- the cases: their matrix, a list that needs no script, and the data drawn on a click ----------
# The matrix is a table of clauses and their groups of cases, by verdict or by report. Every
# string stands once in the data, in one table; the cases refer to it by number. Each entry of a
# wire log is described in the grammar's words.


_CASE = Path(__file__).parent / "assets" / "case.html"
_KINDS = {"sent": 0, "received": 1, "look": 2, "clipped": 3}


def case_rows(cases: Sequence[Row]) -> Safe:
    """One row for each case, closed; its details are drawn when it is opened."""
    return joined(_row(index, row) for index, row in enumerate(cases))


def _row(index: int, row: Row) -> Safe:
    worst = max((result for result in row.results if result), key=lambda r: r.verdict)
    words = worst.reason if worst.verdict is not Verdict.PASS else ""
    named = [
        (r.verdict.label, r.verdict.label) if r else ("missing", "not run") for r in row.results
    ]
    marks = {name for name, _ in named} | ({"differs"} if row.differs else set())
    badges = (tag("span", label, class_=f"badge v-{name}") for name, label in named)
    return filled(
        _CASE,
        index=index,
        id=row.id,
        clause=row.clause,
        group=row.group,
        marks=" ".join(sorted(marks)),
        badges=joined(badges),
        dim="" if words else " dim",
        words=words or worst.requirement,
    )


_Number = Callable[[str], int]
"""Gives a string's place in the table in which every string stands once."""


def case_data(
    reports: Sequence[Report], told: Sequence[str], cases: Sequence[Row], protocol: Protocol
) -> dict[str, Any]:
    """The data that the page's script draws: for each row each report's case, null for none."""
    table: dict[str, int] = {}

    def strings(words: str) -> int:
        return table.setdefault(words, len(table))

    words = [WireWords(protocol, report) for report in reports]
    drawn = [
        [
            result and _case(strings, told_by, result)
            for told_by, result in zip(words, row.results, strict=True)
        ]
        for row in cases
    ]
    rest_on = {axis.reading for row in cases for r in row.results if r for axis in r.axes.values()}
    rest_on |= {result.reading for row in cases for result in row.results if result}
    readings = {
        reading.id: {
            "clause": reading.clause,
            "point": reading.point,
            "quote": reading.quote,
            "default": reading.default,
            "others": reading.others,
        }
        for reading in READINGS
        if reading.id in rest_on
    }
    return {
        "runs": list(told),
        "known": [told_by.known for told_by in words],
        "readings": readings,
        "cases": drawn,
        "strings": list(table),
    }


def _clauses(result: CaseResult) -> str:
    """The case's own clause, and the one that its failure violates where that is another."""
    planned = result.planned_clause
    return planned if result.clause == planned else f"{planned}; what fails: {result.clause}"


def _case(strings: _Number, words: WireWords, result: CaseResult) -> dict[str, Any]:
    return {
        "v": result.verdict.label,
        "c": strings(_clauses(result)),
        "q": strings(result.requirement),
        "r": strings(result.reading or ""),
        "a": [
            [strings(name), axis.verdict.label]
            + [strings(w) for w in (axis.expected, axis.actual, axis.reason, axis.reading or "")]
            for name in AXES
            if (axis := result.axes.get(name))
        ],
        "s": [strings(frame) for frame in result.sent],
        "again": strings(result.reproduce),
        "log": [
            [event.ns // 1000, _KINDS[event.kind], strings(event.hex), strings(meaning)]
            for event, meaning in zip(result.log, words.of(result.log), strict=True)
        ],
    }


class WireWords:
    """The words for the wire logs of one report.

    `known` is false for a report that was made with another grammar than `protocol`: its bytes are
    not described. Frames are described as a conforming device would find them in the bytes.
    """

    def __init__(self, protocol: Protocol, report: Report) -> None:
        self.known = report.grammar.sha256 == protocol.sha256
        self._protocol = protocol
        measured = report.profile.truncation_timeout_ms
        self._timeout = int((measured or protocol.timing.truncation_timeout) * MS)
        self._frame = lru_cache(maxsize=None)(self._describe)

    def of(self, log: Iterable[WireEvent]) -> Iterator[str]:
        """The words for each entry of a log."""
        framer = Framer(self._protocol, self._timeout)
        for event in log:
            if event.look or not self.known:
                yield event.look
            elif event.kind == "sent":
                yield self._sent(framer, event)
            else:
                framer.advance(event.ns + self._timeout // 2)  # an answer ends a frame with a pause
                codes = bytes.fromhex(event.hex)
                yield _told(code_words(self._protocol, code) for code in codes)

    def _sent(self, framer: Framer, event: WireEvent) -> str:
        framer.advance(event.ns)
        begun = bool(framer.held)
        words = [
            self._frame(frame.data) for frame in framer.feed(bytes.fromhex(event.hex), event.ns)
        ]
        if begun:
            words.insert(0, "(goes on)")
        if framer.held:
            words.append(f"{judge(self._protocol, framer.held).describe()} so far")
        return _told(words)

    def _describe(self, frame: bytes) -> str:
        judgement = judge(self._protocol, frame)
        if judgement.valid:
            return judgement.describe()
        due = code_words(self._protocol, judgement.response.code)
        return f"{judgement.describe()} (faulty, {due} is due)"


def _told(words: Iterable[str]) -> str:
    """The words one after another, equal ones counted."""
    counted = ((word, len(list(run))) for word, run in groupby(words))
    return ", ".join(word if count == 1 else f"{count} × {word}" for word, count in counted)


_BAR = 160  # units of a bar's width


def matrix(told: Sequence[str], cases: Sequence[Row]) -> Safe:
    """A row for each clause and, below it, one for each group of its cases.

    About one report the columns are verdicts, about several they are the reports. Each number
    leads to its cases: `data-c`, `data-g` and `data-v` say which those are.
    """
    clauses: dict[str, list[Row]] = {}
    for row in cases:
        clauses.setdefault(row.clause, []).append(row)
    columns = list(tally(result for row in cases for result in row.results))  # the worst first
    several = len(told) > 1
    titles = (
        [tag("th", name, scope="col", class_="run") for name in told]
        if several
        else [tag("th", v.label, scope="col", class_="number") for v in columns]
        + [tag("th", "share", scope="col", class_="share")]
    )
    head = tag("thead", tag("tr", tag("th", "clause and cases", scope="col"), *titles))
    bodies = []
    for clause, its in clauses.items():
        lines = [_line(clause, clause, "", its, columns, several, "clause")]
        lines += [
            _line(name, clause, name, found, columns, several, "group")
            for name, found in by_group(its).items()
        ]
        bodies.append(tag("tbody", *lines))
    foot = tag("tfoot", _line("all cases", "", "", cases, columns, several, "all"))
    return tag("div", tag("table", head, *bodies, foot, class_="matrix"), class_="scroll")


def _line(
    name: str,
    clause: str,
    group: str,
    found: Sequence[Row],
    columns: Sequence[Verdict],
    several: bool,
    look: str,
) -> Safe:
    def link(words: object, verdict: str, css: str = "") -> Safe:
        where = {"data_c": clause, "data_g": group, "data_v": verdict}
        return tag("a", words, href="#cases", **where, class_=css or None)

    count = f"{len(found):,}"
    head = tag(
        "th", link(name, ""), " ", tag("span", count, class_="dim size"), scope="row", class_=look
    )
    if several:
        cells = [
            tag("td", _tallied([row.results[index] for row in found], link), class_="run")
            for index in range(len(found[0].results))
        ]
        return tag("tr", head, *cells)
    counts = tally([row.results[0] for row in found])
    cells = [
        tag(
            "td",
            link(f"{counts[v]:,}", v.label, f"n v-{v.label}") if v in counts else "",
            class_="number",
        )
        for v in columns
    ]
    return tag("tr", head, *cells, tag("td", _share(counts), class_="share"))


def _tallied(results: Sequence[CaseResult | None], link: Callable[[str, str, str], Safe]) -> Safe:
    """One report's verdicts on some cases, the worst first."""
    counts = tally(results)
    parts = [link(f"{n:,} {v.label}", v.label, f"badge v-{v.label}") for v, n in counts.items()]
    missing = sum(result is None for result in results)
    if missing:
        parts.append(link(f"{missing:,} not run", "missing", "badge v-missing"))
    return joined(parts)


def _share(counts: dict[Verdict, int]) -> Safe:
    """The share of each verdict as a strip; the numbers beside it say the same."""
    total = sum(counts.values())
    x, parts = 0.0, []
    for verdict in sorted(counts):
        # Even a small share must be visible.
        width = max(counts[verdict] / total * _BAR, 3.0)
        parts.append((x, width, verdict.label))
        x += width
    scale = _BAR / x if x else 1.0
    return bar(_BAR, [(f"{at * scale:.2f}", f"{w * scale:.2f}", name) for at, w, name in parts])


_PAGE = Path(__file__).parent / "assets"


def as_html(reports: Sequence[Report], protocol: Protocol) -> str:
    """One page about one report, or about several side by side.

    Bytes are described in the words of `protocol`, in reports that were made with this grammar.
    """
    style = (_PAGE / "report.css").read_text(encoding="utf-8")
    script = (_PAGE / "report.js").read_text(encoding="utf-8")
    told, cases, several = names(reports), rows(reports), len(reports) > 1
    failed = ("Causes",) if any(report.causes for report in reports) else ()
    links = (*failed, "Matrix", "Cases", "Profile", "Coverage")
    device = tag("span", *told, class_="device")
    none = tag("p", "No case was judged.", class_="dim")
    body = filled(
        _PAGE / "report.html",
        title=f"{len(reports)} runs side by side"
        if several
        else joined(["Conformance of ", device]),
        verdicts=joined(map(_verdict, reports, told if several else [""])),
        links=joined(tag("a", word, href=f"#{word.lower()}") for word in links),
        causes=joined(causes(reports, told, protocol)),
        matrix=matrix(told, cases) if cases else none,
        chips=joined(_chips(reports, cases)),
        columns=_columns(told) if several else "",
        runs=f"runs-{min(len(told), 6)}",
        list=case_rows(cases),
        profile=profile(reports, told),
        coverage=coverage(reports, told),
        facts=facts(reports, told),
        data=json_block("data", case_data(reports, told, cases, protocol)),
    )
    title = f"{', '.join(told)} · bilprov conformance report"
    return html_page(title, body, style=style, script=script)


def _verdict(report: Report, name: str) -> Safe:
    """How a run ended; `name` is said of several."""
    device = tag("span", name, class_="device") if name else ""
    verdict = run_report.EXIT_VERDICTS[report.exit].label
    return tag("p", device, run_report.conclusion(report).plain, class_=f"conclusion v-{verdict}")


def _columns(told: list[str]) -> Safe:
    """A numbered list that says which column of the list of cases is which report."""
    entries = [tag("li", tag("b", index), " ", name) for index, name in enumerate(told, 1)]
    return tag("ol", *entries, class_="columns")


def _chips(reports: Sequence[Report], cases: list[Row]) -> Iterator[Safe]:
    """Yield a button for each verdict, by which the cases are filtered."""
    counts = tally(result for row in cases for result in row.results)
    per: list[tuple[str, str, int]] = [
        (verdict.label, verdict.label, sum(verdict in _verdicts(row) for row in cases))
        for verdict in counts
    ]
    if len(reports) > 1:
        per.append(("missing", "not in all", sum(None in row.results for row in cases)))
        per.append(("differs", "differing", sum(row.differs for row in cases)))
    for name, word, count in per:
        words = tag("span", word, class_="word"), tag("span", f"{count:,}", class_="count")
        look = {"class_": f"chip v-{name}", "data_v": name, "aria_pressed": "false"}
        if count:
            yield tag("button", *words, type="button", **look)


def _verdicts(row: Row) -> set[Verdict]:
    return {result.verdict for result in row.results if result}


_SIGNS = {"sent": "→", "received": "←", "look": "◉", "clipped": "…"}


def causes(reports: Sequence[Report], told: Sequence[str], protocol: Protocol) -> Iterator[Safe]:
    """Yield a section with the causes of each run that has some."""
    for report, name in zip(reports, told, strict=True):
        if report.causes:
            words, left = WireWords(protocol, report), report.unexplained
            unexplained = f"No cause found for {quantity(left, 'failed case')}."
            yield filled(
                _PAGE / "causes.html",
                title="Causes" if len(reports) == 1 else f"Causes: {name}",
                causes=joined(_cause(report, cause, words) for cause in report.causes),
                left=tag("p", unexplained, class_="dim") if left else "",
            )


def _cause(report: Report, cause: Cause, words: WireWords) -> Safe:
    links = (
        tag("a", ident, href=f"#case={ident}", class_="id", title="the case")
        for ident in cause.cases
    )
    return filled(
        _PAGE / "cause.html",
        sentence=cause.sentence,
        clause=cause.clause,
        line=report.send_line(cause),
        wire=_wire(cause.log, words) if cause.log else "",
        shown=tag("p", cause.shown, class_="shown") if cause.shown else "",
        count=quantity(len(cause.cases), "case"),
        links=joined(links),
    )


def _wire(log: Sequence[WireEvent], words: WireWords) -> Safe:
    rows = (
        tag(
            "tr",
            tag("td", f"{event.t * 1e3:.1f} ms", class_="number"),
            tag("td", _SIGNS[event.kind]),
            tag("td", event.hex, class_="hex"),
            tag("td", meaning),
        )
        for event, meaning in zip(log, words.of(log), strict=True)
    )
    return tag("table", tag("tbody", *rows), class_="wire")


_POINTS = {reading.id: reading for reading in READINGS}
_UNSAID: tuple[Any, ...] = (None, False, "", (), [], {})


def facts(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """A section with device, grammar, line, seed and options of each run."""
    each = [_facts(report) for report in reports]
    known = dict.fromkeys(key for facts_of in each for key, value in facts_of.items() if value)
    lines = {key: [_plain(facts_of.get(key)) for facts_of in each] for key in known}
    if len(told) == 1:
        entries = (tag("div", tag("dt", key), tag("dd", *cells)) for key, cells in lines.items())
        shown = tag("dl", *entries, class_="grid")
    else:
        shown = _table(lines, told)
    return tag("section", shown, id="facts", aria_label="Run")


def _facts(report: Report) -> dict[str, Any]:
    """The facts of a run; one that is not known or not given is empty or left out."""
    return {
        "device": report.device,
        "grammar": _grammar(report),
        "line": report.link.get("line"),
        "probe": report.link.get("probe"),
        "fault": report.fault,
        "seed": tag("code", report.seed),
        "options": _options(report),
        "bilprov": report.kit,
        **run_report.run_facts(report),
        "versions": report.versions,
    }


def _grammar(report: Report) -> Safe:
    grammar = report.grammar
    short = tag("code", grammar.sha256[:12], title=grammar.sha256)
    return Safe(f"{text(grammar.name)} {text(grammar.version)} {short}")


def _options(report: Report) -> Safe:
    """The options that were set; the others have their defaults."""
    options = asdict(report.options)
    told = {name: v for name, v in options.items() if v not in _UNSAID and name != "seed"}
    if "profile" in told:
        told["profile"] = "given"  # its content is in the profile below
    if not told:
        return tag("span", "defaults", class_="dim")
    return _value(told)


def _plain(value: object) -> object:
    return tag("span", "none", class_="dim") if value in _UNSAID else _value(value)


def profile(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """Tables of every entry of every profile: measured values, and the device's choices."""
    figures = [structs.asdict(report.profile) for report in reports]
    if all(value is None for told_of in figures for value in told_of.values()):
        return tag("p", "Nothing was measured.", class_="dim")
    lines: dict[str, list[Any]] = {}
    for name in ("proof", "timing"):
        told_of = [getattr(report, name) for report in reports]
        if any(told_of):
            lines[name] = [_value(value) for value in told_of]
    for key in figures[0]:
        if key != "readings":
            lines[_words(key)] = [_value(told_of[key]) for told_of in figures]
    return joined([_table(lines, told), _readings(reports, told)])


def _readings(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """A table of each device's choices where the document is silent."""
    chosen = [report.profile.readings or {} for report in reports]
    points = dict.fromkeys(point for values in chosen for point in values)
    if not points:
        return Safe("")
    titles = told if len(told) > 1 else ["shown"]
    head = tag(
        "tr",
        tag("th", "where the document is silent", scope="col"),
        tag("th", "default", scope="col"),
        *(tag("th", name, scope="col") for name in titles),
    )
    lines = []
    for point in points:
        known = _POINTS.get(point.partition(" ")[0])
        about = tag("th", tag("code", point), " ", known.point if known else "", scope="row")
        cells = [tag("td", _value(values.get(point))) for values in chosen]
        default = default_of(point)
        words = f" {known.default}" if known and known.default != default else ""
        usual = tag("td", tag("b", default), words)
        lines.append(tag("tr", about, usual, *cells))
    table = tag("table", tag("thead", head), tag("tbody", *lines), class_="readings")
    return Safe(tag("h3", "Readings that the device showed") + tag("div", table, class_="scroll"))


def coverage(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """A table of coverage: how much was exercised out of how much, in numbers and as a bar."""
    keys = dict.fromkeys(key for report in reports for key in report.coverage)
    if not keys:
        return tag("p", "Nothing was exercised.", class_="dim")
    return _table(
        {key: [_covered(report.coverage.get(key)) for report in reports] for key in keys}, told
    )


def _covered(covered: run_report.Covered | None) -> Safe:
    if covered is None:
        return tag("span", "not recorded", class_="dim")
    done, of = covered.done, covered.of
    share = min(done / of, 1.0) if of else 0.0
    shown = bar(100, [("0", "100", "none"), ("0", f"{share * 100:.2f}", "done")])
    return tag("span", tag("span", f"{done:,} of {of:,}", class_="of"), shown, class_="covered")


def _table(lines: dict[str, list[Any]], told: Sequence[str]) -> Safe:
    """One line for each fact, one column for each report."""
    head = Safe("")
    if len(told) > 1:
        columns = (tag("th", name, scope="col") for name in told)
        head = tag("thead", tag("tr", tag("td", ""), *columns))
    body = [
        tag("tr", tag("th", name, scope="row"), *(tag("td", cell) for cell in cells))
        for name, cells in lines.items()
    ]
    table = tag("table", head, tag("tbody", *body), class_="facts")
    return tag("div", table, class_="scroll")


def _words(key: object) -> str:
    name, _, unit = str(key).rpartition("_")
    words = f"{name} ({unit})" if unit in ("ms", "s") else str(key)
    return words.replace("_", " ")


def _value(value: object) -> Safe:
    """Any value of a JSON file as HTML."""
    if isinstance(value, Safe):
        return value
    if value is None:
        return tag("span", "not known", class_="dim")
    if isinstance(value, bool):
        return text("yes" if value else "no")
    if isinstance(value, dict):
        lines = [
            tag("div", tag("dt", _words(key)), tag("dd", _value(inner)))
            for key, inner in value.items()
        ]
        return tag("dl", *lines)
    if isinstance(value, list | tuple):
        if not value:
            return tag("span", "none", class_="dim")
        return tag("ul", *(tag("li", _value(inner)) for inner in value))
    return text(value)
