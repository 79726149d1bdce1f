"""What the probe has shown in a run, and of which cases it did not show enough.

What was not seen is never a pass: a case is inconclusive where one of its looks did not show
whether the robot moves, or a facet that the probe had shown before. That is decided here, for
every look of a run and every result, whoever made them.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass
from functools import cache

import msgspec

from bilprov.analyzer.client.operations import Observation, Operation, Reply
from bilprov.captures.schemas import Look
from bilprov.conformance.oracle.state_model import FrameEffect
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.spec.protocol import Protocol

NOT_OBSERVABLE = "not observable"
SEEN_AXES = ("stop", "state")
"""The axes that are judged by looks."""


@cache
def _facets(protocol: Protocol) -> dict[str, str]:
    """The facets of a look, in words."""
    settings = {name: f"the {protocol.noun(name)}" for name in protocol.settings}
    moving = {"moving": "whether the robot moves", protocol.car.by: "the direction"}
    return {**moving, **settings, "wheels": "the wheels"}


def facets_of(protocol: Protocol, look: Look) -> set[str]:
    """The facets that a look shows; both wheels are one."""
    shown = {name for name in _facets(protocol) if getattr(look, name, None) is not None}
    return shown if look.left is None or look.right is None else shown | {"wheels"}


def untold(protocol: Protocol, tested: Iterable[str], shown: Container[str]) -> str:
    """Which of the tested facets a probe that shows these does not tell, "" if none.

    Its wheels show all of a robot but its lights.
    """
    hidden = tested if "wheels" not in shown else filter(protocol.lights.__contains__, tested)
    blind = [facet for facet in hidden if facet not in shown]
    return f"the probe does not report {', '.join(blind)}" if blind else ""


def facets_set(protocol: Protocol, frame_effects: Iterable[FrameEffect]) -> list[str]:
    """The facets that these frames set; a fault sets none, it stops the robot."""
    effects = {frame.effect for frame in frame_effects if frame.effect is not None}
    names = [n for n in protocol.settings if any(effect.sets(n) for effect in effects)]
    return [protocol.car.by, *names] if any(map(protocol.car.moves, effects)) else names


@dataclass(slots=True)
class _Gap:
    """The looks that did not show a facet: the first, the case it was in, how many."""

    first: int
    case: str
    looks: int = 0


class Sight:
    """What the looks of a run have shown; it follows the run's operations.

    `looks` is how many there were, `missed` how many of them lacked a facet, `shown` the facets
    that any has shown.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
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
        if not isinstance(reply, Observation):
            return
        look = reply.look
        self.looks += 1
        shown = facets_of(self._protocol, look)
        if shown == self.shown and "moving" in shown and not self._gaps:
            return
        missing = (self.shown | {"moving"}) - shown
        if look.moving is False:
            missing -= {self._protocol.car.by, "wheels"}  # known of a robot that stands still
        self.shown |= shown
        self.missed += bool(missing)
        if missing:
            self._missing.setdefault(self._case, set()).update(missing)
        for facet in missing:
            self._gaps.setdefault(facet, _Gap(self.looks, self._case)).looks += 1

    def judged(self, result: CaseResult) -> CaseResult:
        """The final result of a case, in which nothing passes that its looks did not show."""
        missing = self._missing.pop(result.id, set())
        if result.id == self._case:
            self._case = ""
        if not missing:
            return result
        words = ", ".join(words for facet, words in self._facets if facet in missing)
        reason = f"{NOT_OBSERVABLE}: the probe did not report {words}"
        axes = dict(result.axes)
        if result.verdict < Verdict.INCONCLUSIVE and not axes.keys() & set(SEEN_AXES):
            axes["state"] = Axis(Verdict.SKIPPED, "", "")
        for name in axes.keys() & set(SEEN_AXES):
            if axes[name].verdict < Verdict.INCONCLUSIVE:
                axes[name] = msgspec.structs.replace(
                    axes[name], verdict=Verdict.INCONCLUSIVE, reason=reason, reading=""
                )
        return result.with_axes(axes)

    @property
    def _facets(self) -> Iterable[tuple[str, str]]:
        return _facets(self._protocol).items()

    def sentences(self) -> Iterator[str]:
        """What the probe did not show in the run, each in a sentence."""
        for facet, words in self._facets:
            gap = self._gaps.get(facet)
            if gap is None:
                continue
            where = f"first in case {gap.case}" if gap.case else "first between two cases"
            yield (
                f"In {gap.looks:,} of {self.looks:,} observations the probe did not report "
                f"{words} ({where}, observation {gap.first:,})"
            )
        by, limits = self._protocol.car.by, self._protocol.limits
        settable = {name for name in self._protocol.settings if name in limits}
        if untold(self._protocol, [by], self.shown):
            settable.add(by)
        never = [words for facet, words in self._facets if facet in settable - self.shown]
        if self.looks and never:
            words = ", ".join(never)
            yield f"In none of {self.looks:,} observations did the probe report {words}"
