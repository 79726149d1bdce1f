"""Sweeps speed or steering while the robot drives and judges the wheels' speeds over the sweep.

Each setting is looked at three times after it has settled: the looks agree, or the time for that is
up. A fall is looked for again at its two settings, from rest, before it counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import msgspec

from bilprov.analyzer.client.operations import Procedure, listen, observe, send
from bilprov.captures.schemas import MS, Look
from bilprov.captures.text import quantity
from bilprov.conformance.cases.wheel_sweeps import WheelSweep, evenly
from bilprov.conformance.oracle.verdicts import Axis, CaseResult, Verdict
from bilprov.conformance.oracle.wheel_curve import (
    READING,
    Kind,
    Trait,
    WheelCurve,
    curve_of,
    tolerance,
    traits,
)
from bilprov.conformance.oracle.wording import answer_words
from bilprov.conformance.runner.homing import home, set_up, watch
from bilprov.conformance.runner.run import Run, result_of
from bilprov.spec.codec import judge

_LOOKS = 3  # at each setting
_TRIES, _TWICE = 3, 2
_PAUSE = 2 * MS  # between looks that differ
_PATIENCE = 100 * MS  # for a setting to settle
_SILENCE = 1000 * MS  # for all settings of a sweep to settle
_LONGEST = 5000 * MS  # for all looks of a sweep: where they take longer, fewer settings are swept

Speeds = tuple[int, int]


def sweep_wheels(run: Run, case: WheelSweep) -> Procedure[CaseResult]:
    """Sweep and judge; the curve goes into the profile. Leaves the line homed.

    The case is skipped where the probe does not tell wheel speeds.
    """
    sweep = _Sweep(run, case)
    why = _unseen(run) or (yield from sweep.start())
    if why:
        yield from home(run)
        return _skipped(case, why)
    for value, frame in sweep.settings:
        yield from sweep.measure(value, frame)
    curve = curve_of(case.variable, case.setup.motion, sweep.seen.items())
    axes = {"answer": sweep.answers()}
    if len(sweep.seen) < 2:
        why = "fewer than two settings were taken and seen"
        axes["state"] = Axis(Verdict.INCONCLUSIVE, case.requirement, "", why, READING)
    else:
        before = run.profile.wheels
        if not curve.graded and curve.full <= 1:
            yield from home(run)
            return _skipped(case, "the probe reports directions of the wheels and no speeds")
        found = traits(curve, before)
        axes["state"] = _axis(case, curve, found)
        failing = next((trait for trait in found if trait.kind is Kind.REVERSED), None)
        if failing and not (yield from sweep.again(curve, failing)):
            axes["state"] = run.config.not_reproduced(axes["state"], _TRIES)
        run.profile.wheels = (*before, curve)
    yield from home(run)
    return result_of(case, axes)


def _unseen(run: Run) -> str:
    """Why the wheels' speeds cannot be seen at all, "" if they may be."""
    if not run.config.observability.available:
        return f"not observable ({run.config.observability.why})"
    return "this probe reports no wheel speeds" if run.config.observability.costly else ""


def _skipped(case: WheelSweep, why: str) -> CaseResult:
    result = result_of(case, {"state": Axis(Verdict.SKIPPED, case.requirement, "not run", why)})
    return msgspec.structs.replace(result, frames=0)


def _axis(case: WheelSweep, curve: WheelCurve, found: Sequence[Trait]) -> Axis:
    verdict = found[0].kind.value if found else Verdict.PASS
    last = len(curve.settings) - 1
    seen = f"{curve.beside(0, last)}; observations differ by {curve.spread} at most"
    words = "; ".join(trait.words for trait in found if trait.kind is not Kind.REVERSED)
    if verdict is Verdict.FAIL:
        words = found[0].words
    return Axis(verdict, case.requirement, seen, words, READING if found else "")


class _Sweep:
    """A sweep under way: what was seen at each setting, and which were not taken."""

    def __init__(self, run: Run, case: WheelSweep) -> None:
        self.run = run
        self.case = case
        self.settings = case.settings
        self.seen: dict[int, list[Speeds]] = {}
        self._refused: list[str] = []
        self._recovered: list[str] = []
        self._silence = _SILENCE
        self._full = 0
        # Where a speed counts from the next motion on, or the robot stops by itself, the motion is
        # sent after each setting, or before it where it might reset the setting.
        profile = run.profile
        again = profile.choices.differs("R-speed-moving") or profile.watchdog is not None
        self._again = case.mover if again else b""

    def start(self) -> Procedure[str]:
        """Set the robot in motion; returns why it cannot be swept, "" if it can."""
        run, motion = self.run, self.case.setup.motion
        yield from set_up(run, self.case.setup)
        seen = yield from watch(run, moving=True, patience=run.timers.deadline)
        if _speeds(seen.look) is None:
            return "the probe reports no wheel speeds"
        if not seen.look.moving and motion not in (run.profile.moves or ()):
            return "never seen moving in this motion"
        takes = _LOOKS * (seen.now - seen.asked) + (run.profile.round_trip or 0)
        most = _LONGEST // takes if takes else len(self.settings)
        if most < len(self.settings):
            chosen = evenly(0, len(self.settings) - 1, max(2, most))
            self.settings = tuple(self.settings[place] for place in chosen)
        return ""

    def measure(self, value: int, frame: bytes, *, pause: int = 0) -> Procedure[None]:
        """Set a value, and look until it has settled, at first after `pause` ns.

        A setting that is not answered as it should be is sent again to a robot fresh from rest: a
        spoilt one may have stopped it.
        """
        refusal = ""
        self.seen.pop(value, None)
        for _ in range(_TRIES):
            answered = yield from self._set(frame)
            if not answered:
                looks = yield from self._settled(pause)
                if looks:
                    self.seen[value] = looks
                if refusal:
                    self._recovered.append(refusal)
                return
            refusal = f"{self.case.variable} {value} was answered {answered}"
            yield from self._afresh()
        self._refused.append(refusal)

    def _afresh(self) -> Procedure[None]:
        yield from home(self.run)
        yield from set_up(self.run, self.case.setup)

    def _set(self, frame: bytes) -> Procedure[str]:
        """Send a setting; returns "" if it was taken, else the answers that came, in words."""
        protocol = self.run.protocol
        steers = self.case.variable == "steering"
        for data in (self._again, frame) if steers else (frame, self._again):
            if not data:
                continue
            yield from send(self.run.wire(data))
            heard = yield from self.run.waiting.answers(1)
            if heard.codes != (judge(protocol, data).response.code,):
                return answer_words(protocol, heard.codes)
        return ""

    def _settled(self, pause: int) -> Procedure[list[Speeds]]:
        """Three looks that agree, or six that do not drift apart, or the last when time is up.

        None of them where the probe stops telling the speeds.
        """
        if pause:
            yield from listen(None, pause)
        waited, looks = 0, (yield from self._looks())
        while looks and not self._alike(looks) and waited < _PATIENCE and self._silence > 0:
            heard = yield from listen(None, _PAUSE)
            if heard.answers:
                self.run.strays.unexpected(heard.answers, "came although nothing was sent")
            waited += _PAUSE
            self._silence -= _PAUSE
            before, looks = looks, (yield from self._looks())
            if looks and _spread(_middle(before), _middle(looks)) <= _spread(*before, *looks) / 2:
                return before + looks  # the probe's own spread: the wheels do not change
        return looks

    def _looks(self) -> Procedure[list[Speeds]]:
        looks = list[Speeds]()
        for _ in range(_LOOKS):
            speeds = _speeds((yield from observe()).look)
            if speeds is None:
                return []
            looks.append(speeds)
            self._full = max(self._full, *map(abs, speeds))
        return looks

    def _alike(self, looks: Sequence[Speeds]) -> bool:
        return _spread(*looks) <= tolerance(self._full)

    def again(self, curve: WheelCurve, failing: Trait) -> Procedure[bool]:
        """Whether a failure shows again, in two of three tries from rest."""
        frames, hits = dict(self.settings), 0
        settings = [curve.settings[place] for place in failing.places]
        for _ in range(_TRIES):
            yield from self._afresh()
            for value in settings:
                yield from self.measure(value, frames[value], pause=self.run.timers.silence)
            seen = [(value, self.seen[value]) for value in settings if value in self.seen]
            if len(seen) < len(settings):
                continue
            now = curve_of(curve.variable, curve.motion, seen)
            hits += _fails(now, curve)
        return hits >= _TWICE

    def answers(self) -> Axis:
        """The answer axis: each setting is answered as it should be."""
        expected = f"{quantity(len(self.settings), 'setting')}, each taken"
        told = self._refused or self._recovered
        if not told:
            return Axis(Verdict.PASS, expected, expected)
        more = f" (and {len(told) - 1} more)" if len(told) > 1 else ""
        axis = Axis(Verdict.FAIL, expected, f"{told[0]}{more}", f"{told[0]}{more}")
        return axis if self._refused else self.run.config.not_reproduced(axis, _TRIES)


def _fails(now: WheelCurve, whole: WheelCurve) -> bool:
    """Whether the settings of a failure fail again, on the scale of the whole curve."""
    for series in now.rising().values():
        falls = len(series) > 1 and series[0] - series[-1] > whole.tolerance
        if falls or (len(series) == 1 and -series[0] > whole.tolerance):
            return True
    return False


def _speeds(look: Look) -> Speeds | None:
    """The wheels' speeds, None where the probe does not tell both."""
    return None if look.left is None or look.right is None else (look.left, look.right)


def _spread(*looks: Speeds) -> int:
    """The most by which one wheel's speed differs between looks."""
    return max(
        abs(a - b) for one in looks for other in looks for a, b in zip(one, other, strict=True)
    )


def _middle(looks: Sequence[Speeds]) -> Speeds:
    """The median of each wheel's speed."""
    left, right = (round(median(speeds)) for speeds in zip(*looks, strict=True))
    return left, right
