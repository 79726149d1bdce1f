"""The HTML page, opened and used in a real Chromium; hostile text is never executed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from bilprov.captures.text import escape_controls
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import READINGS
from tests.support.chromium import INSTALL, Page, chromium
from tests.support.reports import a_case, a_run, every_verdict, hostile
from tests.support.surfaces import HOSTILE, Seen

pytestmark = pytest.mark.waits

needs_chromium = pytest.mark.skipif(chromium() is None, reason=INSTALL)
Open = Callable[..., Page]


@pytest.fixture
def show(page: Page, protocol: Protocol, tmp_path: Path) -> Open:
    """Opens a page about some reports; nothing may complain, nothing else may be asked for."""

    def opened(*reports: Report, grammar: Protocol | None = None) -> Page:
        file = tmp_path / "report.html"
        file.write_text(as_html(reports, grammar or protocol), encoding="utf-8")
        page.open(file.as_uri())
        assert page.complaints == []
        assert page.requests == [file.as_uri()]
        return page

    return opened


@pytest.fixture(scope="module")
def failing(protocol: Protocol) -> Report:
    only = ("bad-data/LED/1?", "unused-id/9/*", "valid/LED/*")
    return a_run(protocol, *only, fault="restarts-by-itself")


def visible_ids(page: Page) -> list[str]:
    return list(
        page.eval(
            "[...document.querySelectorAll('#list details')].filter(row => row.checkVisibility())"
            ".map(row => row.querySelector('.id').textContent)"
        )
    )


def ids(report: Report, *verdicts: Verdict) -> list[str]:
    return [r.id for r in report.results if not verdicts or r.verdict in verdicts]


def open_case(page: Page, ident: str) -> str:
    """Click a case; gives the text of what is inside."""
    row = f'#list details[data-id="{ident}"]'
    page.click(f"{row} summary")
    # On a busy machine the list may have moved on between finding the place and the click.
    page.eval(
        f"(d => d.open || d.querySelector('summary').click())(document.querySelector('{row}'))"
    )
    page.wait(f"document.querySelector('{row} .inside')")
    return str(page.eval(f"document.querySelector('{row} .inside').innerText"))


def wire_log(page: Page) -> list[list[str]]:
    """The wire log that is open: its cells, row by row."""
    return list(
        page.eval(
            "[...document.querySelectorAll('.log tbody tr')]"
            ".map(row => [...row.cells].map(cell => cell.textContent))"
        )
    )


# -- what is in the file --------------------------------------------------------------------------


def test_matrix_and_cases_are_there_without_any_script(failing: Report, protocol: Protocol) -> None:
    text = as_html([failing], protocol).partition("<script")[0]

    for result in failing.results:
        assert f'<span class="id">{result.id}</span>' in text
    assert "sim does not conform" in text
    assert '<table class="matrix">' in text


@pytest.mark.parametrize("evil", HOSTILE.values(), ids=HOSTILE)
def test_hostile_text_makes_no_element_and_no_attribute(protocol: Protocol, evil: str) -> None:
    tame = Seen(as_html([hostile(protocol, "tame")], protocol)).elements
    text = as_html([hostile(protocol, evil)] * 2, protocol)
    wild = Seen(text).elements

    assert {tag for tag, _ in wild} <= {tag for tag, _ in tame} | {"ol", "li", "b", "article"}
    assert len([tag for tag, _ in wild if tag == "script"]) == 2
    known = {key for _, attributes in tame for key in attributes}
    assert {key for _, attributes in wild for key in attributes} <= known
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u202e\ud800-\udfff]", text)
    block = text.partition('id="data">')[2].partition("</script>")[0]
    assert not set("<>&") & set(block)
    assert escape_controls(evil) in json.loads(block)["strings"]


# -- in the browser -------------------------------------------------------------------------------


@needs_chromium
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_open_filter_click_and_read(
    failing: Report, page: Page, show: Open, width: int, scheme: str
) -> None:
    failed = [result for result in failing.results if result.verdict is Verdict.FAIL]
    page.size(width)
    page.scheme(scheme)
    show(failing)

    # Nothing is wider than the window, and the ground is as light or dark as was asked for.
    assert page.eval("document.documentElement.scrollWidth") == width
    red = page.eval("+getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0]")
    assert (red > 128) is (scheme == "light")
    assert "sim does not conform" in page.eval("document.querySelector('.conclusion').innerText")

    # What did not pass is there first; then everything; then what passed.
    assert visible_ids(page) == [result.id for result in failed]
    page.click("#everything")
    assert visible_ids(page) == ids(failing)
    page.click('.chip[data-v="pass"]')
    assert visible_ids(page) == ids(failing, Verdict.PASS)
    assert page.eval("document.querySelector('.chip[data-v=pass]').ariaPressed") == "true"
    page.click('.chip[data-v="pass"]')
    page.click('.chip[data-v="fail"]')
    assert visible_ids(page) == [result.id for result in failed]
    assert f"{len(failed)} of {len(failing.results)}" in page.eval("shown.textContent")

    # One case, with everything that is known of it.
    case = failed[0]
    inside = open_case(page, case.id)
    told = [case.requirement, case.clause, *case.sent, case.reproduce]
    for axis in case.axes.values():
        told += [axis.expected, axis.actual, axis.reason]
    for words in told:
        assert words in inside, words
    log = wire_log(page)
    assert [row[3] for row in log] == [event.hex for event in case.log]
    assert [row[0] for row in log] == [f"{event.ns // 1000 / 1000:.3f}" for event in case.log]
    arrows = {"sent": "host →", "received": "← device", "look": "probe"}
    assert [row[2] for row in log] == [arrows[event.kind] for event in case.log]
    assert page.eval("document.documentElement.scrollWidth") == width
    assert page.complaints == []


@needs_chromium
def test_the_wire_log_says_what_bytes_mean(protocol: Protocol, show: Open) -> None:
    report = a_run(protocol, "bad-data/LED/9", "truncated/Speed/14/7", fault="ok-to-bad-data")
    page = show(report)
    open_case(page, "bad-data/LED/9")
    meanings = {row[3]: row[4] for row in wire_log(page)}

    assert meanings["81 09"] == "LED rgb=9 (faulty, 02 BAD_DATA is due)"
    assert meanings[" ".join(["00"] * 16)] == "16 × Stop"
    assert meanings["00"] == "00 OK"
    look = next(row[4] for row in wire_log(page) if row[2] == "probe")
    assert look.startswith("moving")


@needs_chromium
def test_the_timing_picture_has_a_mark_for_each_entry(failing: Report, show: Open) -> None:
    case = next(result for result in failing.results if result.verdict is Verdict.FAIL)
    page = show(failing)
    open_case(page, case.id)
    kinds = [event.kind for event in case.log]

    assert page.eval("document.querySelectorAll('.timing .host').length") == kinds.count("sent")
    answers = page.eval("document.querySelectorAll('.timing .device').length")
    assert answers == kinds.count("received")
    circles = "[...document.querySelectorAll('.timing circle')]"
    places = page.eval(f"{circles}.map(circle => circle.cx.baseVal.value)")
    assert len(places) == kinds.count("look")
    assert places == sorted(places)
    assert page.eval("document.querySelectorAll('.timing .moving').length") == sum(
        event.look.startswith("moving") for event in case.log
    )
    assert "20.0 ms" in page.eval("document.querySelector('.timing').textContent")


@needs_chromium
def test_a_reading_is_told_with_its_point_default_and_verdicts(
    protocol: Protocol, show: Open
) -> None:
    result = a_case("made/1", Verdict.NON_STRICT, "slow", "R-answer-deadline")
    inside = open_case(show(replace(every_verdict(protocol), results=(result,))), "made/1")

    (told,) = [reading for reading in READINGS if reading.id == "R-answer-deadline"]
    assert told.others
    for words in (told.id, told.clause, told.point, told.default, *sum(told.others, ())):
        assert words in inside, words


@needs_chromium
def test_search_and_matrix_narrow_the_list(failing: Report, show: Open) -> None:
    page = show(failing)
    page.click("#everything")

    page.click("#search")
    page.type("LED/1")
    assert visible_ids(page) == [ident for ident in ids(failing) if "LED/1" in ident]

    page.click('.matrix a[data-g="unused-id"][data-v="pass"]')
    wanted = [i for i in ids(failing, Verdict.PASS) if i.startswith("unused-id/")]
    assert visible_ids(page) == wanted
    assert page.eval("scope.textContent").endswith("unused-id ×")

    page.click("#scope")
    assert visible_ids(page) == ids(failing, Verdict.PASS)


@needs_chromium
def test_a_case_opens_by_keyboard_and_by_its_address(failing: Report, show: Open) -> None:
    page = show(failing)
    first = visible_ids(page)[0]

    page.eval("document.querySelector('#list details:not([hidden]) summary').focus()")
    page.press("Enter", 13, "\r")
    page.wait("document.querySelector('details[open] .inside')")
    assert page.eval("decodeURIComponent(location.hash)") == f"#case={first}"

    # A case that the filter hides is found by its address too.
    passed = ids(failing, Verdict.PASS)[-1]
    page.eval(f"location.hash = '#case={passed}'")
    page.wait(f"document.querySelector('details[data-id=\"{passed}\"][open] .inside')")
    assert passed in visible_ids(page)


@needs_chromium
@pytest.mark.parametrize("place", [".cause .again", "#list .again"])
def test_the_line_to_try_it_again_is_copied(failing: Report, show: Open, place: str) -> None:
    page = show(failing)
    case = ids(failing, Verdict.FAIL)[0]
    page.call("Browser.grantPermissions", permissions=["clipboardReadWrite"])
    open_case(page, case)

    page.click(f"{place} button")
    page.wait(f"/Copied|Selected/.test(document.querySelector('{place} button').textContent)")

    again = next(r.reproduce for r in failing.results if r.id == case)
    again = failing.send_line(failing.causes[0]) if "cause" in place else again
    assert page.eval(f"document.querySelector('{place} code').textContent") == again
    if page.eval(f"document.querySelector('{place} button').textContent") == "Copied":
        assert page.eval("navigator.clipboard.readText()") == again


@needs_chromium
@pytest.mark.sample(2)
@pytest.mark.parametrize("evil", HOSTILE.values(), ids=HOSTILE)
def test_hostile_text_does_not_run(protocol: Protocol, show: Open, evil: str) -> None:
    report = hostile(protocol, evil)
    page = show(report, replace(report, device="other"))
    page.click("#everything")
    count = page.eval("document.querySelectorAll('#list summary').length")
    page.eval("document.querySelectorAll('#list summary').forEach(row => row.click())")
    page.wait(f"document.querySelectorAll('.inside').length === {count}")

    assert count == 2
    assert page.eval("window.hit") is None
    assert page.eval("document.querySelectorAll('img, [onerror], [onmouseover]').length") == 0
    assert page.eval("document.querySelectorAll('script').length") == 2
    assert page.eval("document.querySelector('.id').textContent") == escape_controls(
        f"{evil}/{evil}"
    )
    assert page.eval("document.querySelector('.required').textContent") == escape_controls(evil)
    assert page.complaints == []


@needs_chromium
def test_a_script_that_got_in_all_the_same_would_be_refused(
    page: Page, show: Open, failing: Report
) -> None:
    show(failing)

    page.eval(
        "(() => { const s = document.createElement('script'); s.textContent = 'window.hit = 1';"
        "document.body.append(s); })()"
    )

    assert page.eval("window.hit") is None
    page.wait("true")
    assert any("Content Security Policy" in words for words in page.complaints)


@needs_chromium
def test_several_runs_stand_side_by_side(protocol: Protocol, page: Page, show: Open) -> None:
    good = a_run(protocol, "bad-data/LED/1?", "valid/LED/1")
    bad = a_run(protocol, "bad-data/LED/1?", fault="restarts-by-itself")
    page.size(400)
    show(good, bad)
    failed = ids(bad, Verdict.FAIL)

    assert page.eval("document.documentElement.scrollWidth") == 400
    assert visible_ids(page) == failed
    badges = f'details[data-id="{failed[0]}"] .badges .badge'
    assert page.eval(f"[...document.querySelectorAll('{badges}')].map(b => b.textContent)") == [
        "pass",
        "fail",
    ]
    inside = open_case(page, failed[0])
    assert "sim\xa0" in inside or "sim " in inside
    assert "--fault restarts-by-itself" in inside
    assert page.eval("document.querySelectorAll('.inside article').length") == 2

    page.click("#everything")
    page.click('.chip[data-v="missing"]')
    assert visible_ids(page) == ["valid/LED/1"]
    assert "This run has no such case." in open_case(page, "valid/LED/1")


@needs_chromium
def test_profile_and_coverage_are_shown(failing: Report, show: Open) -> None:
    readings = {"R-fault-state": "speed zeroed", "R-new": "of a later kit"}
    page = show(replace(failing, profile=replace(failing.profile, boot_ms=12.5, readings=readings)))
    profile = page.eval("document.querySelector('#profile').innerText")
    coverage = page.eval("document.querySelector('#coverage').innerText")

    for words in ("boot (ms)", "12.5", "what a fault resets", "speed zeroed", "R-new"):
        assert words in profile, words
    for name, covered in failing.coverage.items():
        assert name in coverage
        assert f"{covered.done:,} of {covered.of:,}" in coverage


@needs_chromium
def test_five_thousand_cases_are_drawn_only_when_opened(protocol: Protocol, show: Open) -> None:
    results: tuple[CaseResult, ...] = tuple(
        a_case(f"made/{n}", Verdict.FAIL if n == 4321 else Verdict.PASS) for n in range(5000)
    )
    page = show(replace(every_verdict(protocol), results=results))

    assert visible_ids(page) == ["made/4321"]
    assert page.eval("document.querySelectorAll('.inside').length") == 0
    open_case(page, "made/4321")
    assert page.eval("document.querySelectorAll('.inside').length") == 1
    assert wire_log(page)[-1][4] == "7 entries are left out here"
