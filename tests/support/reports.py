"""Reports for tests of the writers: a real run with every verdict, and a hostile report."""

from __future__ import annotations

import dataclasses
import re
from io import StringIO

from msgspec.structs import replace
from rich.console import Console

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.profile import Figures
from bilprov.conformance.oracle.verdicts import AnswerByte, Axis, CaseResult, Verdict, WireEvent
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.json_report import as_json, parse_report
from bilprov.conformance.report.junit import as_junit
from bilprov.conformance.report.markdown import as_markdown
from bilprov.conformance.report.run_report import Comparison, Covered, Grammar, Report
from bilprov.conformance.report.summary import show
from bilprov.spec.protocol import Protocol

_STOPPED = Axis(Verdict.PASS, "stopped", "stopped")


def a_run(protocol: Protocol, *only: str, fault: str = "", seed: int = 1) -> Report:
    device = Simulator(protocol, fault_bank(protocol)[fault]) if fault else Simulator(protocol)
    options = Options(only=only, seed=seed)
    return conform(device, grammar=protocol, options=options, fault=fault or None)


def a_case(ident: str, verdict: Verdict, reason: str = "a reason", reading: str = "") -> CaseResult:
    """A case that ended so, with a short log."""
    return CaseResult(
        id=ident,
        clause="section 4, table 2",
        requirement="answers as the table says",
        verdict=verdict,
        axes={"answer": Axis(verdict, "00 OK", "01 BAD_HEADER", reason, reading)}
        | ({} if verdict is Verdict.SKIPPED else {"stop": _STOPPED}),
        reading=reading,
        sent=("11 7f",),
        received=(AnswerByte("01", 0.0004),),
        reproduce=f"bilprov conform sim --seed 1 --only {ident}",
        log=(
            WireEvent(0.0, "sent", "11 7f"),
            WireEvent(0.000574, "received", "01"),
            WireEvent(0.020574, "look", look="moving forward, speed 127"),
            WireEvent(0.0206, "clipped", look="7 entries are left out here"),
        ),
    )


def with_axes(ident: str, axes: dict[str, Axis]) -> CaseResult:
    """A case with these axes."""
    return a_case(ident, Verdict.PASS).with_axes(axes)


def every_verdict(protocol: Protocol, *, strict: bool = False) -> Report:
    """A report with each verdict once, and three failures."""
    results = [a_case(f"made/{verdict.label}", verdict) for verdict in Verdict]
    results += [a_case(f"more/{n}", Verdict.FAIL, f"reason {n}", "R-led-id") for n in (1, 2)]
    base = a_run(protocol, "valid/LED/1")
    options = dataclasses.replace(base.options, strict=strict)
    return replace(base, results=tuple(results), options=options)


def hostile(protocol: Protocol, evil: str) -> Report:
    """A report read from a file in which every text is hostile."""
    case = a_case(f"{evil}/{evil}", Verdict.FAIL)
    case = replace(
        case,
        clause=evil,
        requirement=evil,
        axes={"answer": Axis(Verdict.FAIL, evil, evil, evil, evil)},
        reading=evil,
        log=(WireEvent(0.0, "sent", "11 7f"), WireEvent(1e-9, "look", look=evil)),
        reproduce=evil,
    )
    unsure = replace(case, id=f"unsure/{evil}", verdict=Verdict.INCONCLUSIVE)
    base = a_run(protocol, "valid/LED/1")
    report = replace(
        base,
        device=evil,
        kit=evil,
        grammar=Grammar(evil, evil, protocol.sha256, evil),
        link={"kind": "virtual", "line": evil, "probe": evil, "fault": evil, evil: evil},
        options=Options(only=(evil,), level=evil, allow=(evil,), profile=evil),
        profile=Figures(facets=(evil,), readings={evil: evil}),
        coverage={evil: Covered(1, 2)},
        ended=evil,
        begun=evil,
        host=evil,
        versions={evil: evil},
        unseen=(evil,),
        notices=(evil,),
        proof=evil,
        comparison=Comparison(evil, 0, 1, (evil,)),
        results=(case, unsure),
    )
    return parse_report(as_json(report), evil)


def shown(report: Report, *, everything: bool = False, width: int = 200) -> str:
    """The summary of a report as a terminal shows it."""
    text = StringIO()
    show(report, Console(file=text, width=width), everything=everything)
    return text.getvalue()


def every_form(report: Report, protocol: Protocol) -> dict[str, str]:
    """A report in each form that is for people or for other programs, but JSON."""
    forms = {"markdown": as_markdown, "html": as_html, "junit": as_junit}
    written = {name: form([report], protocol) for name, form in forms.items()}
    return written | {"summary": shown(report, width=1000)}


_WHEN = re.compile(
    rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00"
    rb"|(?<=took)(?:_s\": |\" value=\"| `|</dt><dd>| )[0-9.]+"
)


def timeless(written: bytes) -> bytes:
    """A report in any form without when it was made and how long the run took."""
    return _WHEN.sub(b"", written)
