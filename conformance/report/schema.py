"""The JSON of a report as structs, from which it is written and read back.

The fields of a struct are the keys of its object, in this order. A file may be hostile: hex,
verdicts and numbers are checked here. Keys that no struct has (a later kit wrote them) are ignored.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from bilprov.conformance.oracle.verdicts import Cause, Label, WireKind

Seconds = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Milliseconds = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
Hex = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{2}( [0-9a-f]{2})*)?$")]
Count = Annotated[int, msgspec.Meta(ge=0)]
_Bounded = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]


class Axis(msgspec.Struct):
    """One axis of a case; its verdict is `skipped` where the case has no such axis."""

    verdict: Label
    expected: str
    actual: str
    reason: str
    reading: str | None = None


class AnswerByte(msgspec.Struct):
    """One answer byte; `t` is in s since the stimulus had gone."""

    hex: Hex
    t: Seconds


class WireEvent(msgspec.Struct):
    """One entry of a wire log; `t` is in s since the log's first entry."""

    t: Annotated[float, msgspec.Meta(ge=0, le=1e9)]
    kind: WireKind
    hex: Hex
    look: str


class Case(msgspec.Struct, kw_only=True):
    """One case without its wire log.

    `clause` is the one that its failure violates, `planned_clause` the one that the case stands
    under in every format of the report. `axes` are `answer`, `stop` and `state`. The verdict of an
    `expected_failure` stays `fail`. `frames` are how many frames the case has; a seeded sequence
    that was answered as it should be has neither `sent` nor `received` nor a log.
    """

    id: str
    clause: str
    planned_clause: str | None = None
    requirement: str
    verdict: Label
    axes: dict[str, Axis]
    reading: str | None
    sent: list[Hex]
    received: list[AnswerByte]
    frames: int = 0
    reproduce: str
    expected_failure: bool = False


class LoggedCase(Case, kw_only=True):
    """One case with its wire log."""

    log: list[WireEvent] = []


class Grammar(msgspec.Struct):
    """The grammar that the cases were judged by."""

    name: str
    version: str
    sha256: str
    file: str


class Covered(msgspec.Struct):
    """How much of one kind was exercised, and how much there is."""

    done: Count
    of: Count


class ExpectedFailures(msgspec.Struct):
    """The comparison with a file of expected failures.

    `expected` and `unexpected` are how many cases, `stale` has a sentence for each entry that no
    longer fails.
    """

    file: str
    expected: Count
    unexpected: Count
    stale: list[str]


class Head(msgspec.Struct, kw_only=True):
    """A report without its cases.

    `verdict` and `exit` sum up, `counts` has each verdict. `ended_by` is `error`, `user`, `time`
    (it took three times what was announced) or null.
    `timing` says where the time went, `profile` what was
    measured (ms) and what the device chose where the document is silent. `proof` is what the level
    `complete` has proven, null at other levels. `begun` is when the run began (ISO 8601, UTC),
    `took_s` how long it took (real time, s), `host` the machine's name, each null where it is not
    known; `versions` are those of Python, its platform and the libraries that reports depend on.
    `unseen` has a sentence for what the probe did not show, and from which look on, `notices` one
    for each thing to know of device, line and probe. `causes` explain the failed cases, the worst
    first; `unexplained` is how many of them no cause explains.
    """

    kit: str
    grammar: Grammar
    device: str
    link: dict[str, Any]
    options: dict[str, Any]
    seed: int
    verdict: Label
    exit: Annotated[int, msgspec.Meta(ge=0, le=3)]
    unusable: str | None
    ended: str | None
    ended_by: str | None = None
    counts: dict[str, Count]
    coverage: dict[str, Covered]
    timing: dict[str, int | float] = {}
    profile: dict[str, Any]
    proof: str | None = None
    expected_failures: ExpectedFailures | None = None
    begun: str | None = None
    took_s: Seconds | None = None
    host: str | None = None
    versions: dict[str, str] = {}
    unseen: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()
    unexplained: Count = 0


class Link(msgspec.Struct, kw_only=True):
    """The keys of `link` that this kit reads."""

    kind: str
    line: str | None = None
    probe: str | None = None
    fault: str | None = None


class _Options(msgspec.Struct):
    only: list[str] = []
    level: str = "standard"
    strict: bool = False
    soak: _Bounded = 0
    allow: list[str] = []


Setting = Annotated[int, msgspec.Meta(ge=-1_000_000_000, le=1_000_000_000)]
_Settings = Annotated[list[Setting], msgspec.Meta(min_length=2, max_length=4096)]


class WheelCurve(msgspec.Struct):
    """The wheels' speeds over a sweep; the fields are those of `oracle.wheel_curve.WheelCurve`."""

    variable: str
    motion: str
    settings: _Settings
    left: _Settings
    right: _Settings
    spread: Setting

    def __post_init__(self) -> None:
        if not len(self.settings) == len(self.left) == len(self.right):
            raise ValueError("a curve of the wheels has one speed of each wheel for each setting")


class _Profile(msgspec.Struct):
    truncation_timeout_ms: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    latency_median_ms: Milliseconds | None = None
    latency_max_ms: Milliseconds | None = None
    facets: list[str] | None = []  # these and the readings may be null in an older report
    wheels: Annotated[list[WheelCurve], msgspec.Meta(max_length=64)] = []
    readings: dict[str, Any] | None = {}


class _OpenParts(msgspec.Struct, kw_only=True):
    """The objects of a report that may have any further keys; those read here have their type."""

    link: Link
    options: _Options
    profile: _Profile


class Document(Head, kw_only=True):
    """A whole report."""

    cases: list[LoggedCase]

    def __post_init__(self) -> None:
        """Check the known keys of the objects that keep every key of the file."""
        open_parts = {"link": self.link, "options": self.options, "profile": self.profile}
        msgspec.convert(open_parts, _OpenParts)
