"""Judges a recorded run again from its bytes and looks alone, and compares the verdicts.

The run is made as every run is made (`conformance.api.run_suite`), over the recording instead of a
device. Recorded verdicts are only compared with: what a case and each of its axes came to, and the
bytes that it rests on, not the sentences that explain it. Checksums reveal damage,
not forgery: a recording that is written anew as a whole can hold anything that is consistent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from bilprov.analyzer.files import from_json
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.capture_decoding import capture_protocol
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.schemas import CaseMark, look_class
from bilprov.captures.text import quantity
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.target import TOPICS, Environment, RecordedLink, Strayed, Target
from bilprov.conformance.oracle.verdicts import CaseResult, worst
from bilprov.conformance.report.json_report import as_json
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.conformance.runner.listeners.recorder import RUN, VERDICT
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.captures.reader import Evidence

SUMMED = ("verdict", "exit", "counts", "coverage", "profile")
"""The parts of a report, besides its cases, that must come out the same."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A result that differs from the recorded one.

    `about` is the case's id or the part of the report, `what` says which of its values differ.
    """

    about: str
    what: str
    recorded: str
    judged: str


@dataclass(frozen=True, slots=True)
class Recheck:
    """The result of a recheck. `report` is None where the run strayed from the recording.

    `cases` is how many were judged again and compared, `verdict` the worst of their new verdicts.
    `notes` say what else the reader should know; `whole` is false where the recording ends before
    its run did, or holds cases of another version of the kit that this one no longer makes.
    """

    report: Report | None
    cases: int
    verdict: str
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    whole: bool

    @property
    def exit(self) -> int:
        """0 the same, 1 something differs, 3 the same as far as it could be judged again."""
        return 1 if self.differences else 0 if self.whole else 3


class _Run(msgspec.Struct, frozen=True):
    kit: str
    grammar: dict[str, str]
    options: Options
    environment: Environment = msgspec.field(name="circumstances")


class _CaseVerdicts(msgspec.Struct):
    id: str
    verdict: str
    sent: list[str]
    received: list[dict[str, Any]]
    axes: dict[str, dict[str, Any]]

    @property
    def compared(self) -> dict[str, Any]:
        """What must come out the same: the verdict, each axis's, and the bytes."""
        axes = {f"{name} axis": axis.get("verdict") for name, axis in self.axes.items()}
        return {"verdict": self.verdict, "sent": self.sent, "received": self.received} | axes


class _Verdicts(msgspec.Struct):
    cases: list[_CaseVerdicts]
    verdict: str | None = None
    exit: int | None = None
    counts: dict[str, Any] | None = None
    coverage: dict[str, Any] | None = None
    profile: dict[str, Any] | None = None


class _Results(RunListener):
    """Keeps the results, also of a run that strays from the recording."""

    def __init__(self) -> None:
        self.results: list[CaseResult] = []
        self.last = "before the first case"

    def begin(self, ident: str) -> None:
        """A case begins."""
        self.last = ident

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self.results.append(result)


def recheck(path: str, grammar: Protocol | None = None) -> Recheck:
    """Judge a recorded run again; by its own grammar unless another is given.

    Raises CaptureError, in one sentence, for a file that is damaged (it names the checksum that
    does not fit), is no recording of a run, or cannot be judged again; GrammarError where its
    grammar is not run because it does more than declare.
    """
    from bilprov.captures.reader import open_evidence

    evidence = open_evidence(path, (RUN, VERDICT))
    run = _run(path, evidence)
    grammar = grammar or capture_protocol(
        [evidence.capture], load_protocol(), run.grammar.get("file", "grammar.py")
    )
    listener = _Results()
    report, strayed, cut = None, "", False
    try:
        link = RecordedLink(evidence.capture.messages(TOPICS), look_class(grammar.state_type))
        target = Target(grammar, run.environment, lambda listener: link, link.interrupted)
        report = run_suite(target, run.options, [listener])
        cut = link.cut
        if link.left:
            strayed = "the recording goes on where the run ends"
    except Strayed as error:
        strayed = str(error)
    except (ArithmeticError, ValueError) as error:
        raise CaptureError(f"{path} cannot be judged again: {error}") from error
    marks = tuple(_marks(evidence))
    recorded = evidence.attachments.get(VERDICT)
    # Another version may make other cases, or make them in another way: that is no difference.
    former = run.kit != kit_version() and (strayed or _gone(marks, listener.results))
    if former:
        marks = tuple(_still_made(marks, listener.results))
    differences = list(_against_marks(marks, listener.results))
    if strayed and not former:
        differences.append(Difference(listener.last, "what is done", "another step", strayed))
    if recorded is not None and report is not None and not cut and not former:
        known = {difference.about for difference in differences}
        against = _against_report(path, recorded, report)
        differences += [d for d in against if d.about not in known]
    judged = listener.results[: len(marks)] if cut or former else listener.results
    # A line that cannot be used is an error although no case was judged.
    whole = report.verdict if report and judged is listener.results else None
    notes = list(_notes(evidence, run, grammar, report, cut=cut))
    if former:
        notes.append(
            "this version no longer makes all of its cases in the way they were recorded: "
            f"{quantity(len(marks), 'case')} could be judged again"
        )
    return Recheck(
        report=report,
        cases=len(judged),
        verdict=(worst(r.verdict for r in judged) if whole is None else whole).label,
        differences=tuple(differences),
        notes=tuple(notes),
        whole=not evidence.capture.unfinished and not cut and not former and recorded is not None,
    )


def _run(path: str, evidence: Evidence) -> _Run:
    counts = evidence.capture.contents.counts
    if topics.HISTORY in evidence.capture.metadata:
        raise CaptureError(
            f"{path} is not a recording as it was made but an edited one (bilprov capture info "
            "shows how): judge the recording itself again"
        )
    if RUN not in evidence.attachments or not counts.get(topics.ASKS):
        raise CaptureError(
            f"{path} is not a recording of a conformance run that can be judged again: make one "
            "with bilprov conform PORT --record FILE.mcap"
        )
    try:
        return from_json(evidence.attachments[RUN], _Run)
    except ValueError as error:
        raise CaptureError(f"{path}: {RUN} cannot be read: {error}") from error


def _marks(evidence: Evidence) -> Iterator[CaseMark]:
    for message in evidence.capture.messages({topics.CASES}):
        try:
            mark = from_json(message.data, CaseMark)
        except ValueError:
            continue  # the case then has no mark, which counts as a difference
        if mark.phase == "end":
            yield mark


def _gone(marks: tuple[CaseMark, ...], results: list[CaseResult]) -> bool:
    """Whether the recording has cases that were not made again."""
    return not {mark.id for mark in marks} <= {result.id for result in results}


def _still_made(marks: tuple[CaseMark, ...], results: list[CaseResult]) -> Iterator[CaseMark]:
    """The marks of the cases that were made again in the same order, up to the first other one."""
    for mark, result in zip(marks, results, strict=False):
        if mark.id != result.id:
            return
        yield mark


def _against_marks(marks: tuple[CaseMark, ...], results: list[CaseResult]) -> Iterator[Difference]:
    """The differences between the results now and those that the recording has marked final."""
    for number, mark in enumerate(marks):
        if number >= len(results):
            yield Difference(mark.id, "verdict", str(mark.verdict), "not judged")
            continue
        now = results[number]
        if now.id != mark.id:
            yield Difference(mark.id, "order", "this case", f"the case {now.id}")
        elif now.verdict.label != mark.verdict:
            yield Difference(mark.id, "verdict", str(mark.verdict), now.verdict.label)


def _against_report(path: str, recorded: bytes, report: Report) -> Iterator[Difference]:
    try:
        was, now = (from_json(text, _Verdicts) for text in (recorded, as_json(report)))
    except ValueError as error:
        raise CaptureError(f"{path}: {VERDICT} cannot be read: {error}") from error
    cases = {case.id: case.compared for case in was.cases}
    for case in now.cases:
        yield from _parts(case.id, cases.pop(case.id, {}), case.compared)
    for ident in cases:
        yield Difference(ident, "verdict", "judged", "no such case")
    summed = ({name: getattr(part, name) for name in SUMMED} for part in (was, now))
    yield from _parts("the report", *summed)


def _parts(about: str, was: dict[str, Any], now: dict[str, Any]) -> Iterator[Difference]:
    """The first of the values that differs; one is enough."""
    for name in was | now:
        if was.get(name) != now.get(name):
            yield Difference(about, name, _text(was.get(name)), _text(now.get(name)))
            return


def _text(value: object) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _notes(
    evidence: Evidence, run: _Run, grammar: Protocol, report: Report | None, *, cut: bool
) -> Iterator[str]:
    if run.kit != kit_version():
        yield (
            f"it was recorded by bilprov {run.kit}, this is "
            f"{kit_version()}: differences may come from the kit"
        )
    if run.grammar.get("sha256") != grammar.sha256:
        yield f"it was recorded with another grammar than {grammar.origin}"
    if evidence.capture.unfinished:
        yield "it was never finished; the checksums (CRC) of what is there match"
    if cut:
        yield "it ends before its run did: what is there was judged again"
    elif report is not None and report.ended:
        yield f"the run ended early: {report.ended}"
