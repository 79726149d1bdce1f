"""Walks a walk: sends its bursts, holds every answer and every look against the model.

It ends at the first mismatch: what comes after one is no longer the walk that was planned.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from conformance.cases.adaptation import as_chosen
from conformance.cases.sequence import Burst, Mismatch, Walk
from conformance.cases.steps import Step
from conformance.dut.operations import Heard, Script, listen, send
from conformance.oracle.judge import MS
from conformance.oracle.state_model import Belief
from conformance.oracle.verdicts import Axis, Verdict
from conformance.runner.run import Run
from conformance.runner.sequence_answers import Early, answered_early, flushes, judge_burst, unasked
from conformance.runner.sequence_state import dwell, look_after


def walk(run: Run, case: Walk) -> Script[Mismatch | None]:
    """Walk on a homed line. The case is left open: the next homing makes it final."""
    return (yield from _Walker(run, case).go())


class _Walker:
    def __init__(self, run: Run, case: Walk) -> None:
        self._run = run
        self._case = case
        self._axes = {"answer": Axis(Verdict.PASS, "each instruction answered once", "as expected")}
        self._looked = 0
        self._coarse = 0
        self._blind = False

    def go(self) -> Script[Mismatch | None]:
        run, case = self._run, self._case
        run.open(case, self._axes, Heard((), 0), 0)
        self._blind = not run.looks_freely or run.moves == set()
        run.belief = run.model.homed(run.model.found())
        found: Mismatch | None = None
        setup = (Burst((step,), looks=False) for step in case.setup)
        for index, burst in enumerate((*setup, *case.bursts), -len(case.setup)):
            if run.belief.rests:
                run.belief = replace(run.belief, rests=frozenset())
            found = yield from self._burst(burst)
            if found:
                found = replace(found, burst=index)
                run.axes[found.name] = found.axis
                break
        if not found and self._blind:
            run.axes["state"] = run.blind("as the model says after each burst")
        elif not found and self._looked and "state" not in run.axes:
            actual = f"{self._looked} looks as expected"
            run.axes["state"] = Axis(Verdict.PASS, "as the model says", actual)
        if self._coarse and not found:
            reason = f"{self._coarse} pauses came out too long for the time-out on this link"
            words = "pauses below the time-out"
            run.axes["answer"] = Axis(Verdict.INFORMATIONAL, words, reason, reason)
        return found

    # -- one burst ----------------------------------------------------------------------------

    def _burst(self, burst: Burst) -> Script[Mismatch | None]:
        run = self._run
        chosen = [as_chosen(run.protocol, run.profile.choices, step) for step in burst.steps]
        for part in self._parts(burst, chosen):
            found = yield from self._part(part)
            if found:
                return found
        return None

    def _parts(self, burst: Burst, chosen: list[Step]) -> Iterator[Burst]:
        """The burst in pieces where a device that loses or lags leaves open what it would do.

        One that loses what follows a fault until the line is idle may do so or not where the line
        pauses; one that stops late has not stopped yet when the next frame comes.
        """
        profile = self._run.profile
        apart = profile.stop_latency or (burst.pauses and profile.flushes)
        whole = replace(burst, steps=tuple(chosen))
        if not apart or len(chosen) == 1:
            yield whole if whole.steps != burst.steps else burst
            return
        steps: list[Step] = []
        for step in chosen:
            steps.append(step)
            if step.faulty or step.deed.stops or step is chosen[-1]:
                yield Burst(tuple(steps), looks=burst.looks, dwell=burst.dwell)
                steps = []

    def _part(self, burst: Burst) -> Script[Mismatch | None]:
        run, chosen = self._run, list(burst.steps)
        stray = yield from listen(None, 0)
        if stray.answers:
            return unasked(run, chosen[0], stray)
        sent, early, usable = yield from self._send(burst, chosen)
        if not usable:
            self._coarse += 1
            yield from self._forget()
            return None
        before, taken = self._take(chosen)
        found = answered_early(run, chosen, early, self._pause)
        if found:
            return found
        found = yield from judge_burst(run, taken, early, sent)
        if found or self._blind or not burst.looks:
            return found
        found = yield from look_after(run, taken[-1], before)
        self._looked += 1
        if not found and run.profile.stop_latency:
            run.hear((yield from listen(None, 2 * run.profile.stop_latency)))
        if not found and burst.dwell:
            found = yield from dwell(run, taken[-1], burst.dwell * MS)
        return found

    def _send(self, burst: Burst, steps: list[Step]) -> Script[tuple[int, Early, bool]]:
        """Send it, with its pauses; tells when, what came in each, and if they were short enough.

        What came is given with how many bytes had gone.
        """
        run, data = self._run, b"".join(step.frame for step in steps)
        places = [p for p in burst.pauses if p < len(data)] if len(data) == len(burst.data) else []
        early: Early = []
        usable, last = True, 0
        for start, end in zip([0, *places], [*places, len(data)], strict=True):
            if start:
                heard = yield from listen(None, self._pause)
                run.hear(heard)
                early.append((start, heard.answers))
                usable = usable and heard.now - last < run.timeout // 2
            last = yield from send(data[start:end])
        return last, early, usable

    @property
    def _pause(self) -> int:
        """How long (ns) a pause inside a frame lasts."""
        return min(self._run.timeout // 8, 4 * MS)

    def _forget(self) -> Script[None]:
        """The device may have cut the frame: wait until it must have, and know nothing."""
        run = self._run
        run.hear((yield from listen(None, 2 * run.timeout + run.usual)))
        run.belief = replace(run.model.found(), loose=frozenset(("speed", "steering", "led")))

    def _take(self, steps: list[Step]) -> tuple[Belief, list[Step]]:
        """What the model makes of them: the belief before the last that counts, and which count."""
        run, before = self._run, self._run.belief
        taken: list[Step] = []
        for step in steps:
            taken.append(step)
            before, run.belief = run.belief, run.model.after(run.belief, step.deed)
            if flushes(run, step):
                break
        return before, taken
