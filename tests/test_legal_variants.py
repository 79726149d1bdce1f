"""Devices that read the document in another legal way: none of them is ever called faulty.

Each is made by hand from the last column of the readings, and misses only by the verdicts that the
column gives it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from captures.schemas import Look
from conformance.faults.words import (
    answers_with,
    faults_only,
    is_truncated,
    stands_still,
    when,
)
from conformance.simulator import MS, Event, Fault, React, Reaction, Simulator, answers
from conformance.verdicts import Verdict
from spec.fields import Outcome
from spec.motion import Motion, State
from spec.protocol import Protocol
from tests.robots import CountingLink, cases_of, run_over

ROTATIONS = (Motion.ROTATE_RIGHT, Motion.ROTATE_LEFT)
TOO_MANY, TOO_FEW = 3, 4


def sets(**variables: int | Motion) -> React:
    return lambda device, event, reaction: replace(
        reaction,
        state=replace(reaction.state, **variables),  # type: ignore[arg-type]
    )


def keeps_steering(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    return replace(reaction, state=replace(reaction.state, steering=event.before.steering))


def motion_of(event: Event) -> Motion | None:
    instruction = event.judgement.instruction
    return instruction.effect.motion if event.judgement.valid and instruction else None


def stops(event: Event) -> bool:
    return motion_of(event) is Motion.STOPPED


def stops_or_fails(event: Event) -> bool:
    return stops(event) or not event.judgement.valid


def drives(event: Event) -> bool:
    return motion_of(event) not in (None, Motion.STOPPED)


def steers_while_rotating(event: Event) -> bool:
    instruction = event.judgement.instruction
    steers = event.judgement.valid and instruction and instruction.effect.sets("steering")
    return bool(steers) and motion_of(event) is None and event.before.motion in ROTATIONS


def announces_data_for_nobody(event: Event) -> bool:
    return event.judgement.outcome is Outcome.UNKNOWN_ID and event.judgement.length > 0


def cut_short_and_too_long(event: Event) -> bool:
    known = event.judgement.instruction
    return is_truncated(event) and known is not None and event.judgement.length > known.length


def late(milliseconds: int) -> React:
    return lambda device, event, reaction: answers(
        reaction, *(code for _, code in reaction.answers), delay=milliseconds * MS
    )


def stops_after(milliseconds: int) -> React:
    return lambda device, event, reaction: replace(
        reaction, state=event.before, later=((milliseconds * MS, reaction.state),)
    )


def speed_at_next_motion(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
    instruction = event.judgement.instruction
    if event.judgement.valid and instruction and instruction.effect.sets("speed"):
        device.memory.pop("speed", None)
        if event.before.motion is not Motion.STOPPED:
            device.memory["speed"] = reaction.state.speed
            return replace(reaction, state=replace(reaction.state, speed=event.before.speed))
    if "speed" in device.memory and drives(event):
        speed = device.memory.pop("speed")
        return replace(reaction, state=replace(reaction.state, speed=speed))
    return reaction


class Flushing(Simulator):
    """Throws away what follows a faulty frame until the line has been idle for 50 ms."""

    idle_at = 0

    def receive(self, data: bytes, now: int) -> None:
        if now < self.idle_at:
            self.idle_at = now + 50 * MS
            self.advance(now)
            return
        before = self.faults
        super().receive(data, now)
        if self.faults > before:
            self.idle_at = now + 50 * MS


class AnsweringAtTheHeader(Simulator):
    """Answers a frame that is wrong at its header at once, and takes its data without a word."""

    skipped = 0
    last = 0

    def receive(self, data: bytes, now: int) -> None:
        for byte in data:
            if self.skipped and now < self.last + 50 * MS:
                self.skipped, self.last = self.skipped - 1, now
                continue
            self.skipped = 0
            identity, length = self.protocol.headers[byte]
            known = self.protocol.by_id.get(identity)
            wrong = length and (known is None or length != known.length)
            if wrong and not self._framer.held:
                self.advance(now)
                self.skipped, self.last = length, now
                self.state = self.protocol.on_fault.apply(self.state)
                self.answer(TOO_MANY if known else 1, now)
            else:
                super().receive(bytes([byte]), now)


class OneAtATime(Simulator):
    """Takes 60 ms for each instruction, and does not begin the next before it has answered."""

    busy = 0

    def answer(self, code: int, at: int) -> None:
        self.busy = max(at, self.busy) + 60 * MS
        super().answer(code, self.busy)


class TellingOnlyWhetherItMoves(Simulator):
    """Its probe sees no speed, so that a speed that a fault has zeroed shows only by standing."""

    def look(self, now: int) -> Look:
        return Look(t=now, moving=super().look(now).moving)


def reacting(react: React) -> Callable[[Protocol], Simulator]:
    return lambda protocol: Simulator(protocol, Fault("variant", "variant", "", react=react))


def with_timeout(milliseconds: int) -> Callable[[Protocol], Simulator]:
    fault = Fault("variant", "variant", "", timeout=milliseconds * MS)
    return lambda protocol: Simulator(protocol, fault)


def found_set(protocol: Protocol) -> Simulator:
    state = State(speed=90, led=5, steering=20)
    return Simulator(protocol, Fault("variant", "variant", "", power_on=state))


INFORMATIONAL, NON_STRICT, PASS = Verdict.INFORMATIONAL, Verdict.NON_STRICT, Verdict.PASS
VARIANTS: dict[str, tuple[Callable[[Protocol], Simulator], Verdict]] = {
    "R-unused-length: too many": (
        reacting(when(announces_data_for_nobody, answers_with(TOO_MANY))),
        NON_STRICT,
    ),
    "R-unused-length: too few": (
        reacting(when(announces_data_for_nobody, answers_with(TOO_FEW))),
        NON_STRICT,
    ),
    "R-truncated-known: no answer": (reacting(when(is_truncated, answers_with())), NON_STRICT),
    "R-truncated-unused: too few": (
        reacting(
            when(
                lambda e: is_truncated(e) and e.judgement.instruction is None,
                answers_with(TOO_FEW),
            )
        ),
        NON_STRICT,
    ),
    "R-truncated-long: too many": (
        reacting(when(cut_short_and_too_long, answers_with(TOO_MANY))),
        NON_STRICT,
    ),
    "R-truncation-timeout: 3 ms": (with_timeout(3), NON_STRICT),
    "R-truncation-timeout: 6 ms": (with_timeout(6), PASS),
    "R-truncation-timeout: 500 ms": (with_timeout(500), PASS),
    "R-truncation-timeout: 1.5 s": (with_timeout(1500), NON_STRICT),
    "R-answer-deadline: 60 ms": (lambda p: Simulator(p, latency=60 * MS), PASS),
    "R-answer-deadline: 150 ms": (lambda p: Simulator(p, latency=150 * MS), NON_STRICT),
    "R-answer-deadline: 150 ms after faults": (reacting(faults_only(late(150))), NON_STRICT),
    "R-answer-deadline: 60 ms each, one at a time": (OneAtATime, PASS),
    "R-stop-latency: 50 ms": (reacting(faults_only(stops_after(50))), NON_STRICT),
    "R-answer-point: at the header": (AnsweringAtTheHeader, NON_STRICT),
    "R-drain-known: flushed until idle": (Flushing, NON_STRICT),
    "R-fault-state: speed zeroed": (reacting(faults_only(sets(speed=0))), INFORMATIONAL),
    "R-fault-state: steering kept": (reacting(faults_only(keeps_steering)), INFORMATIONAL),
    "R-stop-steering: kept": (reacting(when(stops, keeps_steering)), NON_STRICT),
    "R-stop-steering: kept by faults too": (
        reacting(when(stops_or_fails, keeps_steering)),
        NON_STRICT,
    ),
    "R-stop-speed: zeroed": (reacting(when(stops, sets(speed=0))), NON_STRICT),
    "R-stop-speed: zeroed by faults too": (
        reacting(when(stops_or_fails, sets(speed=0))),
        NON_STRICT,
    ),
    "R-drive-steering: straight": (reacting(when(drives, sets(steering=0))), INFORMATIONAL),
    "R-steer-rotating: a curve": (
        reacting(when(steers_while_rotating, sets(motion=Motion.FORWARD))),
        INFORMATIONAL,
    ),
    "R-speed-moving: at the next motion": (reacting(speed_at_next_motion), NON_STRICT),
    "R-led-state: off": (reacting(when(stops_or_fails, sets(led=0))), INFORMATIONAL),
    "R-power-on: another speed": (found_set, INFORMATIONAL),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_another_legal_reading_gets_its_verdict_and_never_a_failure(
    name: str, protocol: Protocol
) -> None:
    make, verdict = VARIANTS[name]
    runner = run_over(CountingLink(make(protocol)), protocol, cases_of(protocol))

    worst = max(runner.books.results, key=lambda result: result.verdict)
    assert not runner.unusable
    assert worst.verdict is verdict, (worst.id, worst.reason)


def test_a_reading_that_a_device_rests_on_is_named(protocol: Protocol) -> None:
    for name, (make, verdict) in VARIANTS.items():
        if verdict is PASS:
            continue
        cases = cases_of(protocol, "valid/Stop", "*/[1-9]", "*/0", "timing/*", "valid/R*")[::9]
        runner = run_over(CountingLink(make(protocol)), protocol, cases)
        readings = {axis.reading for r in runner.books.results for axis in r.axes.values()}
        if any(result.verdict is verdict for result in runner.books.results):
            assert readings - {""}, name


def test_a_probe_that_sees_only_motion_does_not_take_a_zeroed_speed_for_a_broken_restart(
    protocol: Protocol,
) -> None:
    fault = Fault("variant", "variant", "", react=faults_only(sets(speed=0)))
    device = TellingOnlyWhetherItMoves(protocol, fault)
    runner = run_over(CountingLink(device), protocol, cases_of(protocol, "unused-id/9/*"))

    # Where the setting that is tried after the stop happens to be the speed, nothing shows.
    verdicts = {r.verdict for r in runner.books.results if r.id.startswith("unused-id")}
    assert verdicts == {INFORMATIONAL, PASS}


def test_but_a_robot_that_no_new_speed_wakes_after_a_fault_fails(protocol: Protocol) -> None:
    def dead(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        broken = device.faults > 3 or not event.judgement.valid
        return stands_still(device, event, reaction) if broken else reaction

    fault = Fault("dead", "variant", "", react=dead)
    device = TellingOnlyWhetherItMoves(protocol, fault)
    runner = run_over(CountingLink(device), protocol, cases_of(protocol, "unused-id/9/*"))

    assert Verdict.FAIL in {result.verdict for result in runner.books.results}
