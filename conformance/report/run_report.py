"""The report of a run as one value, from which every form of it and the exit code come.

Every form has its conclusion, one line. A run of the level `complete` says what it has proven.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from bilprov.analyzer.client.operations import Ended
from bilprov.analyzer.files import safe
from bilprov.analyzer.version import kit_version
from bilprov.captures.text import quantity
from bilprov.conformance.cases.levels import COMPLETE, AnyCase, Options, covered
from bilprov.conformance.cases.proof import GROUP, PROOFS, Proof, sequences, silence, suite
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle import verdicts
from bilprov.conformance.oracle.profile import Figures, Profile
from bilprov.conformance.oracle.sight import NOT_OBSERVABLE
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import STATE_POINTS

if TYPE_CHECKING:
    from rich.text import Text


# -- what a run of the level `complete` has proven, and on which assumptions it rests -------------


def proven(
    protocol: Protocol,
    results: Sequence[CaseResult],
    options: Options,
    profile: Figures,
) -> str:
    """A paragraph on what the results prove, "" for another level than `complete`."""
    if options.level != COMPLETE.name:
        return ""
    extra = options.extra
    shown, missing = [], []
    for proof in PROOFS:
        if not proof.applies(protocol):
            continue
        why = _missing(protocol, proof, extra, results, profile)
        if why:
            missing.append(f"Nothing is proven by {proof.seen(protocol)}: {why}.")
        else:
            shown.append(_machine(protocol, proof, extra))
    if shown:
        shown = [
            "Proven: the device does in every state what the Protocol requires, as far as is "
            "seen by " + "; by ".join(shown) + ".",
            *_assumptions(protocol),
        ]
    return " ".join([*shown, *missing])


def _machine(protocol: Protocol, proof: Proof, extra: int) -> str:
    """The machine of a proof, and among which devices it is the only one that passes."""
    bytes_, told = proof.machine(protocol), suite(protocol, proof, extra)
    states = len(bytes_.machine)
    return (
        f"{proof.seen(protocol)} ({quantity(states, 'state')}, {len(bytes_.classes)} classes of "
        f"bytes and the silence, {quantity(len(told.words), 'word')}): every other device of at "
        f"most {states + extra} states would have failed"
    )


def _assumptions(protocol: Protocol) -> Iterator[str]:
    yield (
        "Assumed: the device treats all bytes of one class alike, speeds above zero among them "
        "(each class took all its values in turn, but not each value in each state)."
    )
    yield (
        "Time has two classes: pauses inside a frame, waiting for answers and observations, far "
        f"below its time-out, and a silence longer than that (between frames {silence(protocol)} "
        "ms)."
    )
    yield (
        f"The reset before each word, {quantity(protocol.longest_frame, protocol.stop.name)} and "
        "the settings that the first state needs, leads there from every state (its answers and "
        "what is seen after it were judged)."
    )
    yield "What the robot does inside a frame was not observed."


def _missing(
    protocol: Protocol,
    proof: Proof,
    extra: int,
    results: Sequence[CaseResult],
    profile: Figures,
) -> str:
    """Why a proof does not hold, "" if it does."""
    unseen = [facet for facet in proof.facets(protocol) if facet not in (profile.facets or ())]
    if unseen:
        return f"no probe reported the robot's {' and '.join(unseen)}"
    others = [p for p in profile.other_readings if proof.looks or p not in STATE_POINTS]
    if others:
        return (
            "the device reads the document differently from the machine "
            f"({', '.join(others)}), so its sequences were a test but not a proof"
        )
    usual, timeout = profile.all_but_two_answers_ms, profile.truncation_timeout_ms
    if usual and timeout and 2 * usual >= timeout:
        return (
            f"answers take up to {usual:g} ms and the time-out is {timeout:g} ms, so a frame "
            "that the device took for a longer one may have passed"
        )
    if timeout and timeout >= silence(protocol):
        return (
            f"the time-out is {timeout:g} ms, and the silences between frames last "
            f"{silence(protocol)} ms"
        )
    own = [r for r in results if r.id.startswith(f"{GROUP}/{proof.name}/")]
    if not own:
        return "none of its sequences was run"
    of = sequences(protocol, proof, extra)
    good = sum(_passed(proof, result) for result in own)
    return "" if good == of else f"{good} of its {quantity(of, 'sequence')} were run and passed"


def _passed(proof: Proof, result: CaseResult) -> bool:
    """Whether a sequence was judged to its end and nothing deviated in what the proof sees."""
    if not proof.looks:
        answer = result.axes.get("answer")
        worse = result.verdict > Verdict.INCONCLUSIVE
        return not worse and answer is not None and answer.verdict is Verdict.PASS
    return result.verdict is Verdict.PASS


class Grammar(msgspec.Struct, frozen=True):
    """The grammar that the cases were judged by."""

    name: str
    version: str
    sha256: str
    file: str


class Covered(msgspec.Struct, frozen=True):
    """How much of one kind was exercised, and how much there is."""

    done: verdicts.Count
    of: verdicts.Count


class Comparison(msgspec.Struct, frozen=True):
    """The result of comparing a run with the entries of `file`.

    `expected` is how many cases fail only as entries say, `unexpected` how many others fail,
    `stale` has a sentence for each entry that no longer fails.
    """

    file: str
    expected: verdicts.Count
    unexpected: verdicts.Count
    stale: tuple[str, ...]


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a run: what was tested, with which options, and what came of it.

    Its JSON has these fields as keys, in this order; those that are not known are null. Keys that
    are no fields (a later kit wrote them) are ignored.

    `kit` is the version that judged. `link` has at least `kind` (`port` or `virtual`), `line`,
    `probe` and `fault`, and `echo` where the line has one. `verdict` is the worst of the results,
    ERROR where nothing could be judged, `counts` how many results have each verdict, `exit` the
    exit code; these follow from the results. `unusable` says why nothing could be judged, `ended`
    why the run ended early; `ended_by` is then `error` (the kit, the port or the probe failed),
    `user`, or `time` (it took three times what was announced). `timing` says where the time went
    (see `Meter`), `profile` what was measured. `proof` is what the level `complete` has proven.
    `comparison` is that with a file of expected failures. `begun` is when the run began (ISO 8601,
    UTC), `took_s` how long it took (real time), `host` the machine's name, `versions` those of
    Python, its platform and libraries. `unseen` says what the probe did not show, and from which
    look on, `notices` what else the user should know of device, line and probe. `causes` explain
    the failed cases, the worst first; `unexplained` is how many of them no cause explains. `file`
    is where the report was read from; it is not in the JSON, nor set for a run of this process.
    """

    kit: str
    grammar: Grammar
    device: str
    link: dict[str, str | int | bool | None]
    options: Options
    seed: int
    verdict: Verdict = Verdict.SKIPPED
    exit: int = 0
    unusable: str | None = None
    ended: str | None = None
    ended_by: str | None = None
    counts: dict[str, verdicts.Count] = {}
    coverage: dict[str, Covered]
    timing: dict[str, int | float] = {}
    profile: Figures
    proof: str | None = None
    comparison: Comparison | None = msgspec.field(default=None, name="expected_failures")
    begun: str | None = None
    took_s: verdicts.Seconds | None = None
    host: str | None = None
    versions: dict[str, str] = {}
    unseen: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    causes: tuple[verdicts.Cause, ...] = ()
    unexplained: verdicts.Count = 0
    file: str | msgspec.UnsetType = msgspec.UNSET
    results: tuple[CaseResult, ...] = msgspec.field(name="cases")

    def __post_init__(self) -> None:
        """Sum the results up."""
        found = Counter(result.verdict for result in self.results)
        counts = {verdict.label: found[verdict] for verdict in Verdict}
        msgspec.structs.force_setattr(self, "counts", counts)
        verdict = Verdict.ERROR if self.unusable else verdicts.worst(found)
        msgspec.structs.force_setattr(self, "verdict", verdict)
        known = {ident for cause in self.causes for ident in cause.cases}
        left = sum(r.verdict is Verdict.FAIL and r.id not in known for r in self.results)
        msgspec.structs.force_setattr(self, "unexplained", left)
        msgspec.structs.force_setattr(self, "exit", self._exit())

    def _exit(self) -> int:
        """The exit code of the run: only failures that are not expected decide it.

        A stale entry makes it 1. An interrupted run with nothing failed has 3, because the rest was
        not judged.
        """
        if self.comparison and self.comparison.stale:
            return 1
        left_out = self.comparison is not None
        counted = (r.verdict for r in self.results if not (left_out and r.expected_failure))
        code = verdicts.exit_code(counted, strict=self.options.strict)
        if self.unusable or (self.ended_by == "error" and code != 1):
            return 2
        return 3 if self.ended_by and code == 0 else code

    def send_line(self, cause: verdicts.Cause) -> str:
        """The command that shows a cause; with a probe it prints what that sees, too."""
        probe = self.link.get("probe") if self.link.get("kind") == "port" else None
        look = ["--probe", str(probe)] if probe else []
        start = send_words(self.grammar.file, self.device, self.link)
        return shlex.join([*start, *look, *cause.send])

    @property
    def fault(self) -> str:
        """The fault that the simulator had, "" for none."""
        return str(self.link.get("fault") or "")


def make_report(
    protocol: Protocol,
    results: Sequence[CaseResult],
    cases: Sequence[AnyCase],
    profile: Profile,
    options: Options,
    *,
    device: str,
    link: dict[str, Any],
    unusable: str = "",
    ended: Ended | None = None,
    **facts: Any,
) -> Report:
    """Put a report together; `ended` is what cut the run short, None for a run to its end.

    `device` and `link` are those of the run's environment, `facts` further fields of the report.
    """
    figures = profile.figures()
    device, link = safe(device), safe(link)
    command = reproducer(protocol.origin, device, link, options)
    sentences = {"unusable": unusable or None, "ended": None if ended is None else str(ended)}
    return Report(
        kit=kit_version(),
        device=device,
        link=link,
        grammar=Grammar(protocol.name, protocol.version, protocol.sha256, protocol.origin),
        options=options,
        seed=options.seed,
        ended_by=None if ended is None else ended.by,
        profile=figures,
        coverage=coverage(protocol, results, cases),
        results=tuple(
            msgspec.structs.replace(result, reproduce=safe(command(result))) for result in results
        ),
        proof=proven(protocol, results, options, figures) or None,
        **safe(sentences | facts),
    )


def compared(report: Report, comparison: Comparison, expected: Container[str]) -> Report:
    """The report with a comparison; `expected` are the ids of the cases that fail as expected."""
    results = tuple(
        msgspec.structs.replace(result, expected_failure=result.id in expected)
        for result in report.results
    )
    return msgspec.structs.replace(report, comparison=comparison, results=results)


def coverage(
    protocol: Protocol, results: Sequence[CaseResult], cases: Sequence[AnyCase]
) -> dict[str, Covered]:
    """How many facts (see `cases.levels`) of each kind the run exercised, out of how many.

    A case that was not run does not count, nor does a sequence that was not judged to its end.
    """
    done = {r.id for r in results if r.counted or (r.sent and r.axes.get("answer") and r.received)}
    done |= {r.id for r in results if "stop" in r.axes or "state" in r.axes}
    broken = {r.id for r in results if r.verdict >= Verdict.INCONCLUSIVE}
    run = [
        c for c in cases if c.id in done and not (isinstance(c, SequenceCase) and c.id in broken)
    ]
    return {name: Covered(*pair) for name, pair in covered(protocol, run).items()}


def run_facts(report: Report) -> dict[str, str]:
    """When, where and with what the run was made, and what to know of it: labels and words.

    What is not known is left out.
    """
    took = "" if report.took_s is None else f"{report.took_s:.1f} s"
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    told = {"begun": report.begun, "took": took, "host": report.host, "versions": versions}
    told["not seen"] = "; ".join(report.unseen)
    told["notice"] = "; ".join(report.notices)
    return {name: words for name, words in told.items() if words}


_SENT = 1_000
"""Characters of what was sent that are shown."""


def evidence(result: CaseResult) -> list[tuple[str, str]]:
    """Labels and words: what was sent, and what was expected and seen on the axes not passed.

    Of a case that failed these are the axes that failed.
    """
    sent = " | ".join(result.sent) or "nothing"
    if result.counted or (result.frames and len(sent) > _SENT):
        sent = f"{result.frames} frames, made again with --only {result.id}"
    rows = [("sent", sent)]
    for name, axis in result.axes.items():
        if axis.verdict in (Verdict.PASS, Verdict.SKIPPED):
            continue
        if result.verdict is Verdict.FAIL and axis.verdict < Verdict.FAIL:
            continue
        reading = f" [{axis.reading}]" if axis.reading else ""
        said = [(name, axis.reason + reading), ("expected", axis.expected), ("got", axis.actual)]
        rows += [(label, words) for label, words in said if words]
    return rows


def evidence_lines(result: CaseResult, command: str) -> Iterator[str]:
    """The lines of `evidence`, and the command that shows the case again."""
    for label, words in (*evidence(result), ("again", command)):
        yield f"{label:10}{words}"


def _named(grammar: str) -> list[str]:
    return ["bilprov"] if grammar == "grammar.py" else ["bilprov", "--grammar", grammar]


def send_words(grammar: str, device: str, link: Mapping[str, Any]) -> list[str]:
    """The command that sends to a device, without what is sent.

    The arguments are those of `reproducer`.
    """
    port = device if link.get("kind") == "port" else "PORT"
    return [*_named(grammar), "send", port, *_line_options(link)]


def _line_options(link: Mapping[str, Any]) -> list[str]:
    """The options of the line that were given: those that the grammar does not say itself."""
    return str(link.get("options", "")).split()


def reproducer(
    grammar: str, device: str, link: dict[str, Any], options: Options
) -> Callable[[CaseResult], str]:
    """The command that runs a case again or, for a sequence, sends the frames that fail.

    `grammar` is the file's name. For the built-in simulator the frames go to `PORT`, where
    `bilprov simulate` serves it.
    """
    at_port = link["kind"] == "port"
    before = shlex.join(
        [*_named(grammar), "conform", device, "--seed", str(options.seed), "--only"]
    )
    given = {
        "--level": options.level if options.level != "standard" else "",
        "--extra": options.extra,
        "--soak": options.soak,
        "--deadline": f"{options.deadline:g}" if options.deadline else "",
        "--probe": link.get("probe") if at_port else "",
        "--fault": link.get("fault"),
    }
    more = [word for name, value in given.items() if value for word in (name, str(value))]
    more += [word for allowed in options.allow for word in ("--allow", allowed)]
    more += _line_options(link)
    after = shlex.join(more)

    def command(result: CaseResult) -> str:
        if result.reproduce:
            return shlex.join([*send_words(grammar, device, link), *result.reproduce.split()])
        return f"{before} {shlex.quote(result.id)} {after}".rstrip()

    return command


STYLES = {
    Verdict.PASS: "green",
    Verdict.INFORMATIONAL: "cyan",
    Verdict.NON_STRICT: "yellow",
    Verdict.INCONCLUSIVE: "magenta",
    Verdict.FAIL: "bold red",
    Verdict.ERROR: "bold white on red",
    Verdict.SKIPPED: "dim",
}

# The verdict whose sign or colour stands for an exit code.
EXIT_VERDICTS = {0: Verdict.PASS, 1: Verdict.FAIL, 2: Verdict.ERROR, 3: Verdict.INCONCLUSIVE}


def conclusion(report: Report) -> Text:
    """The line that says how the run ended, in the colour of its verdict."""
    from rich.text import Text

    if report.unusable:
        return Text(f"not judged: {report.unusable}", STYLES[Verdict.ERROR])
    comparison = report.comparison
    if comparison and comparison.expected and report.exit == 0:
        said = f"{report.device} fails only as expected"
    elif comparison and comparison.stale and not comparison.unexpected:
        said = f"{comparison.file} no longer fits"
    else:
        ends = {0: "conforms", 1: "does not conform"}
        said = f"{report.device} {ends.get(report.exit, 'was not judged in full')}"
    text = Text(f"{said}: {_counts(report)}", STYLES[EXIT_VERDICTS[report.exit]])
    if report.ended:
        text.append(f" (ended early: {report.ended})")
    return text


def _counts(report: Report) -> str:
    """How many cases have each verdict; without a probe, what was not seen and what was right."""
    counts = Counter(result.verdict for result in report.results)
    told = []
    if report.link.get("probe") == "none" and counts[Verdict.INCONCLUSIVE]:
        unseen = Counter(filter(None, map(_unseen, report.results)))
        if unseen:
            what = " and ".join(quantity(count, axis) for axis, count in unseen.most_common())
            told = [f"{what} not seen without a probe"]
            counts[Verdict.INCONCLUSIVE] -= unseen.total()
            if right := counts.pop(Verdict.PASS, 0):
                told.append(f"{quantity(right, 'answer')} right")
    return ", ".join(told + [f"{counts[v]} {v.label}" for v in Verdict if counts[v]])


def _unseen(result: CaseResult) -> str:
    """The axis of an inconclusive case that no probe has seen, "" if there are other reasons."""
    if result.verdict is not Verdict.INCONCLUSIVE:
        return ""
    left = {n: axis for n, axis in result.axes.items() if axis.verdict is Verdict.INCONCLUSIVE}
    seen = any(not axis.reason.startswith(NOT_OBSERVABLE) for axis in left.values())
    return "" if seen else next(iter(left), "")
