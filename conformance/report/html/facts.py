"""The tables of a page about each run: device, options, profile and coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from msgspec import structs

from bilprov.analyzer.html.markup import Safe, bar, joined, tag, text
from bilprov.conformance.oracle.choices import default_of
from bilprov.conformance.report.run_report import Covered, Report, run_facts
from bilprov.spec.readings import READINGS

_POINTS = {reading.id: reading for reading in READINGS}
_UNSAID: tuple[Any, ...] = (None, False, "", (), [], {})


def facts(reports: Sequence[Report], told: Sequence[str]) -> Safe:
    """A section with device, grammar, line, seed and options of each run."""
    lines: dict[str, list[object]] = {
        "device": [report.device for report in reports],
        "grammar": [_grammar(report) for report in reports],
        "line": [_plain(report.link.get("line")) for report in reports],
        "probe": [_plain(report.link.get("probe")) for report in reports],
        "fault": [_plain(report.link.get("fault")) for report in reports],
        "seed": [tag("code", report.seed) for report in reports],
        "options": [_options(report) for report in reports],
        "bilprov": [report.kit for report in reports],
    }
    about = [run_facts(report) for report in reports]
    for name in dict.fromkeys(name for told_of in about for name in told_of):
        lines[name] = [_plain(told_of.get(name)) for told_of in about]
    if any(report.versions for report in reports):
        lines["versions"] = [_plain(report.versions) for report in reports]
    if not any(report.link.get("fault") for report in reports):
        del lines["fault"]
    if len(told) == 1:
        entries = (tag("div", tag("dt", key), tag("dd", *cells)) for key, cells in lines.items())
        shown = tag("dl", *entries, class_="grid")
    else:
        shown = _table(lines, told)
    return tag("section", shown, id="facts", aria_label="Run")


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
        usual = tag("td", tag("b", default_of(point)), " ", known.default if known else "")
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


def _covered(covered: Covered | None) -> Safe:
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
    return str(key).removesuffix("_ms").replace("_", " ") + (
        " (ms)" if str(key).endswith("_ms") else ""
    )


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
