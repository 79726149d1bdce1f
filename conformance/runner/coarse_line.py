"""What a line that delays bytes by different times is too coarse to judge.

Such a line may tear a frame apart, and a good robot then rightly times out inside it: it answers
that the frame was cut short, stops, and takes the other bytes for instructions of their own. Any
answer that the protocol knows may come of that, none may, and any motion: it is inconclusive. An
answer that no device gives does not come of it.

A robot that discards what follows a fault until the line is idle takes it where the line lets the
next byte come a little later.
"""

from __future__ import annotations

import msgspec

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.budget import group
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.oracle.profile import Profile
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict, worst
from bilprov.conformance.runner.waiting import Waiting
from bilprov.spec.open_points import FLUSH_POINTS
from bilprov.spec.protocol import Protocol


class CoarseLine:
    """Decides what of a run may be due to the line, and says so."""

    def __init__(self, protocol: Protocol, waiting: Waiting, profile: Profile) -> None:
        self._codes = protocol.codes
        self._waiting = waiting
        self._profile = profile
        self._beyond: set[str] = set()

    def forbids(self, case: AnyCase) -> bool:
        """Whether a sequence was too fine for this line, and this is another of its set."""
        return isinstance(case, SequenceCase) and group(case.id) in self._beyond

    def explains(self, result: CaseResult) -> bool:
        """Whether the line may be why a case failed."""
        if result.verdict is not Verdict.FAIL or not self.coarse:
            return False
        return all(int(answer.hex, 16) in self._codes for answer in result.received)

    @property
    def coarse(self) -> bool:
        """Whether the line changes what this device hears, as far as times go."""
        return self._waiting.coarse or (
            self._loses and 2 * self._profile.unsteadiness > self._waiting.pause
        )

    @property
    def _loses(self) -> bool:
        """Whether the device discards what follows a fault."""
        profile = self._profile
        return profile.flushes or any(map(profile.choices.differs, FLUSH_POINTS))

    def judged(self, result: CaseResult) -> CaseResult:
        """The result, inconclusive where the line may be why it failed."""
        if not self.explains(result):
            return result
        self._beyond.add(group(result.id))
        axes = {name: self._unsure(axis) for name, axis in result.axes.items()}
        verdict = worst(axis.verdict for axis in axes.values())
        return msgspec.structs.replace(result, axes=axes, verdict=verdict)

    def _unsure(self, axis: Axis) -> Axis:
        if axis.verdict is not Verdict.FAIL:
            return axis
        reason = f"{self.sentence}: {axis.reason}"
        return msgspec.structs.replace(axis, verdict=Verdict.INCONCLUSIVE, reason=reason)

    @property
    def sentence(self) -> str:
        """What the line does, and what cannot be judged over it."""
        late, finest = self._profile.unsteadiness / MS, self._waiting.finest / MS
        behind = ", nor what is sent right behind a fault" if self._loses else ""
        return (
            f"the line delays bytes by up to {late:.0f} ms: pauses inside a frame and time-outs "
            f"below {finest:.0f} ms cannot be judged{behind}"
        )
