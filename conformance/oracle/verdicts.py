"""Verdicts and the results that carry them. A verdict only gets worse.

Results are written into a report's JSON as they are here: a field is a key, times are in seconds.
What a file holds is checked against these types when it is read.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import total_ordering
from typing import Annotated, Literal

import msgspec

WireKind = Literal["sent", "received", "look", "clipped"]
Hex = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{2}( [0-9a-f]{2})*)?$")]
Seconds = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Count = Annotated[int, msgspec.Meta(ge=0)]

AXES = ("answer", "stop", "state")
"""The axes that a case can have, in the order in which they are shown."""


@total_ordering
class Verdict(Enum):
    """Verdicts from best to worst; a case takes its worst axis's, a run its worst case's."""

    SKIPPED = "skipped"
    PASS = "pass"
    INFORMATIONAL = "informational"
    NON_STRICT = "non-strict"
    INCONCLUSIVE = "inconclusive"
    FAIL = "fail"
    ERROR = "error"

    def __lt__(self, other: Verdict) -> bool:
        """Whether this verdict is better than another."""
        return _RANKS[self] < _RANKS[other]

    @property
    def label(self) -> str:
        """The verdict's name as it is written out: `non-strict`."""
        return self.value


_RANKS = {verdict: rank for rank, verdict in enumerate(Verdict)}
VOUCHED = (Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT)
"""The verdicts of what conforms, perhaps with remarks."""
LABELS: dict[str, Verdict] = {verdict.label: verdict for verdict in Verdict}


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The worst verdict; SKIPPED where there is none."""
    return max(verdicts, default=Verdict.SKIPPED)


class Axis(msgspec.Struct, frozen=True):
    """One axis of a case (answer, stop or state): what was expected and what was seen."""

    verdict: Verdict
    expected: str
    actual: str
    reason: str = ""
    reading: str | None = None

    def __post_init__(self) -> None:
        """An empty reading is none."""
        if not self.reading:
            msgspec.structs.force_setattr(self, "reading", None)

    def uncertain(self, before: str = "", after: str = "") -> Axis:
        """This axis, inconclusive if it failed, for its reason between these words."""
        if self.verdict is not Verdict.FAIL:
            return self
        reason = f"{before}{self.reason}{after}"
        return msgspec.structs.replace(self, verdict=Verdict.INCONCLUSIVE, reason=reason)


NO_AXIS = Axis(Verdict.SKIPPED, "", "", "not part of this case")
"""What a report has for an axis that a case does not have."""


class AnswerByte(msgspec.Struct, frozen=True):
    """One answer byte: its hex, and its time in s since the case's stimulus had been sent."""

    hex: Hex
    t: Seconds


class WireEvent(msgspec.Struct, frozen=True, gc=False):
    """One entry of a case's wire log: `t` is in s since the log's first entry.

    `kind` is `sent` or `received` (`hex` has the bytes, spaced), `look` (`look` has the probe's
    reading in words), or `clipped`, where the log leaves something out and `look` says how much.
    """

    t: Annotated[float, msgspec.Meta(ge=0, le=1e9)]
    kind: WireKind
    hex: Hex = ""
    look: str = ""

    @property
    def ns(self) -> int:
        """The time in ns."""
        return round(self.t * 1e9)


class CaseResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a judged case. `sent` and `received` are the stimulus's, without the set-up.

    `clause` is the one that a failure violates, `planned_clause` the one that the case was made for
    and stands under, whether it passes or fails. `log` is everything on the wire since the case
    began, set-up and homing included. `reproduce` is, in a report, the command that shows the
    failure again; before that the arguments of `bilprov send`, "" where the case's id is enough.
    `frames` are how many frames it has under test. A seeded sequence that was answered as it should
    be keeps this number alone: its id and the run's seed make it again. The verdict of an
    `expected_failure` stays `fail`.
    """

    id: str
    clause: str
    planned_clause: str = ""
    requirement: str
    verdict: Verdict
    axes: dict[str, Axis]
    reading: str | None
    sent: tuple[Hex, ...]
    received: tuple[AnswerByte, ...]
    frames: int = 0
    reproduce: str = ""
    expected_failure: bool = False
    log: tuple[WireEvent, ...] = ()

    def __post_init__(self) -> None:
        """An empty reading is none; a case of no other clause stands under the one it violates."""
        if not self.reading:
            msgspec.structs.force_setattr(self, "reading", None)
        if not self.planned_clause:
            msgspec.structs.force_setattr(self, "planned_clause", self.clause)

    @property
    def counted(self) -> bool:
        """Whether only the number of its frames is kept, and not what they were."""
        return bool(self.frames and not self.sent and self.verdict is not Verdict.SKIPPED)

    @property
    def sends(self) -> bool:
        """Whether the command that shows it again sends the frames, instead of running the case."""
        return " send " in self.reproduce

    @property
    def group(self) -> str:
        """The first part of the id."""
        return self.id.split("/")[0]

    @property
    def reason(self) -> str:
        """The reason of the worst axis, "" where there is none."""
        worst_axis = max(self.axes.values(), key=lambda axis: axis.verdict, default=None)
        return worst_axis.reason if worst_axis else ""

    def with_axes(self, axes: dict[str, Axis]) -> CaseResult:
        """This result with other axes, the worst of which is its verdict."""
        verdict = worst(axis.verdict for axis in axes.values())
        return msgspec.structs.replace(self, axes=axes, verdict=verdict)

    def uncertain(
        self, before: str = "", after: str = "", only: Iterable[str] = AXES
    ) -> CaseResult:
        """This result, those of its axes inconclusive that failed: see `Axis.uncertain`."""
        doubted = {n: self.axes[n].uncertain(before, after) for n in only if n in self.axes}
        return self.with_axes(self.axes | doubted)


class Cause(msgspec.Struct, frozen=True):
    """A cause of failures: one deviation of the device, and the condition under which it shows.

    `sentence` says it in words, with how sure it is; `when` is the condition alone. `axis` is the
    worst axis of the case that it fails (answer, stop or state), `clause` the one that it violates,
    `cases` the ids of the cases that it explains, `others` how many cases met the condition and
    were right. `send` are arguments of `bilprov send PORT` that show it; `tried` whether they were
    tried on the device, `log` what then passed over the wire, and `shown` what deviated there.
    """

    sentence: str
    when: str
    axis: str
    clause: str
    cases: tuple[str, ...]
    others: int
    send: tuple[str, ...]
    tried: bool = False
    log: tuple[WireEvent, ...] = ()
    shown: str = ""


def exit_code(verdicts: Iterable[Verdict], *, strict: bool = False) -> int:
    """1 if any case failed; else 2 if any is an error; else 3 if any is inconclusive; else 0.

    With `strict` a non-strict case counts as failed.
    """
    found = set(verdicts)
    if Verdict.FAIL in found or (strict and Verdict.NON_STRICT in found):
        return 1
    if Verdict.ERROR in found:
        return 2
    return 3 if Verdict.INCONCLUSIVE in found else 0


@dataclass(frozen=True, slots=True)
class Accepted:
    """A list of answers that may come, the verdict that it gets and the reading that it rests on.

    `word` is the choice of the case's open point that it shows, "" for the default.
    """

    codes: tuple[int, ...]
    verdict: Verdict = Verdict.PASS
    reading: str = ""
    word: str = ""
