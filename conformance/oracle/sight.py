"""What the probe has shown in a run, and of which cases it did not show enough.

What was not seen is never a pass: a case is inconclusive where one of its looks did not show
whether the robot moves, or a facet that the probe had shown before. That is decided here, for
every look of a run and every result, whoever made them.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass

import msgspec

from bilprov.analyzer.client.operations import Observation, Operation, Reply
from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.state_model import VARIABLES, FrameEffect
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict, worst
from bilprov.spec.motion import Motion

NOT_OBSERVABLE = "not observable"
SEEN_AXES = ("stop", "state")
"""The axes that are judged by looks."""

_FACETS = {
    "moving": "whether the robot moves",
    "motion": "the direction",
    "speed": "the speed",
    "steering": "the steering",
    "led": "the LED",
    "wheels": "the wheels",
}
_STILL = frozenset(("motion", "wheels"))  # known of a robot that does not move


def facets_of(look: Look) -> set[str]:
    """The facets that a look shows; both wheels are one."""
    shown = {name for name in _FACETS if getattr(look, name, None) is not None}
    return shown if look.left is None or look.right is None else shown | {"wheels"}


def untold(tested: Iterable[str], shown: Container[str]) -> str:
    """Which of the tested facets a probe that shows these does not tell, "" if none.

    Its wheels show all of a robot but its LED.
    """
    blind = [f for f in tested if f not in shown and (f == "led" or "wheels" not in shown)]
    return f"the probe does not report {', '.join(blind)}" if blind else ""


def facets_set(frame_effects: Iterable[FrameEffect]) -> list[str]:
    """The facets that these frames set; a fault sets none, it stops the robot."""
    effects = {frame.effect for frame in frame_effects if frame.effect is not None}
    moves = any(effect.motion not in (None, Motion.STOPPED) for effect in effects)
    names = [name for name in VARIABLES if any(effect.sets(name) for effect in effects)]
    return ["motion", *names] if moves else names


@dataclass(slots=True)
class _Gap:
    """The looks that did not show a facet: the first, the case it was in, how many.

    `over` if a later look showed it.
    """

    first: int
    case: str
    looks: int = 0
    over: bool = False


class Sight:
    """What the looks of a run have shown; it follows the run's operations.

    `looks` is how many there were, `missed` how many of them lacked a facet, `shown` the facets
    that any has shown.
    """

    def __init__(self) -> None:
        self.looks = self.missed = 0
        self.shown: set[str] = set()
        self._case = ""
        self._missing: dict[str, set[str]] = {}
        self._gaps: dict[str, _Gap] = {}

    def begin(self, ident: str) -> None:
        """A case begins; looks since the last one ended count for it too."""
        self._missing.setdefault(ident, set()).update(self._missing.pop("", ()))
        self._case = ident

    def did(self, operation: Operation, reply: Reply) -> None:
        """Take note of an operation that was done."""
        if isinstance(reply, Observation):
            self._note(reply.look)

    def _note(self, look: Look) -> None:
        self.looks += 1
        shown = facets_of(look)
        missing = (self.shown | {"moving"}) - shown
        if look.moving is False:
            missing -= _STILL
        self.shown |= shown
        self.missed += bool(missing)
        for facet in self._gaps.keys() & shown:
            self._gaps[facet].over = True
        if missing:
            self._missing.setdefault(self._case, set()).update(missing)
            for facet in missing:
                gap = self._gaps.setdefault(facet, _Gap(self.looks, self._case))
                gap.looks += 1
                gap.over = False

    def judged(self, result: CaseResult) -> CaseResult:
        """The final result of a case, in which nothing passes that its looks did not show."""
        missing = self._missing.pop(result.id, set())
        if result.id == self._case:
            self._case = ""
        if not missing:
            return result
        words = ", ".join(words for facet, words in _FACETS.items() if facet in missing)
        reason = f"{NOT_OBSERVABLE}: the probe did not report {words}"
        axes = dict(result.axes)
        if result.verdict < Verdict.INCONCLUSIVE and not axes.keys() & set(SEEN_AXES):
            axes["state"] = Axis(Verdict.SKIPPED, "", "")
        for name in axes.keys() & set(SEEN_AXES):
            if axes[name].verdict < Verdict.INCONCLUSIVE:
                axes[name] = msgspec.structs.replace(
                    axes[name], verdict=Verdict.INCONCLUSIVE, reason=reason, reading=""
                )
        verdict = worst((result.verdict, *(axis.verdict for axis in axes.values())))
        return msgspec.structs.replace(result, axes=axes, verdict=verdict)

    def sentences(self, variables: Container[str]) -> Iterator[str]:
        """What the probe did not show in the run, each in a sentence.

        `variables` are those of the robot that instructions set.
        """
        for facet, words in _FACETS.items():
            gap = self._gaps.get(facet)
            if gap is None:
                continue
            where = f"first in case {gap.case}" if gap.case else "first between two cases"
            if gap.over:
                yield (
                    f"In {gap.looks:,} of {self.looks:,} observations the probe did not report "
                    f"{words} "
                    f"({where}, observation {gap.first:,})"
                )
            else:
                yield (
                    f"From observation {gap.first:,} of {self.looks:,} on the probe did not report "
                    f"{words} ({where})"
                )
        settable = [name for name in VARIABLES if name in variables]
        never = [name for name in settable if name not in self.shown]
        never = ["motion"] * bool(untold(["motion"], self.shown)) + never
        if self.looks and never:
            words = ", ".join(_FACETS[facet] for facet in never)
            yield f"In none of {self.looks:,} observations did the probe report {words}"
