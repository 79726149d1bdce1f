"""Learns a target from the first byte to the last stop, and says what came of it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field

from bilprov.analyzer.client.operations import Link, Procedure, drive, send
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.case import in_motion
from bilprov.conformance.cases.steps import Step
from bilprov.conformance.dut.target import Target
from bilprov.conformance.learning.learner import Difference, Learner, NotLearned, Sent, System
from bilprov.conformance.learning.reference import (
    FACETS,
    Output,
    alphabet,
    facet_words,
    item_of,
    name_of,
    reference_machine,
    reset,
    seen_without,
)
from bilprov.conformance.machines.wp_method import Mealy, minimal
from bilprov.conformance.oracle.choices import Choices, verdict_of
from bilprov.conformance.oracle.profile import Profile, timers_of
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.oracle.verdicts import Verdict, exit_code
from bilprov.conformance.report.run_report import send_words
from bilprov.conformance.runner.executor import Runner
from bilprov.conformance.runner.homing import home, set_up, watch
from bilprov.conformance.runner.run import Run, RunConfig
from bilprov.conformance.runner.waiting import GaveUp
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol


@dataclass(slots=True)
class Learned:
    """What came of learning a target.

    `steps` are the inputs, `machine` is the device's, None where it was not learned, and then
    `trouble` says why in a sentence. `expected_states` is how many the Protocol's machine has over
    the same inputs, as far as it was seen. `differences` were each seen on the device, the shortest
    first; `more` says that there are others. `choices` are the open points at which the device
    chooses otherwise than the kit, with its word and the verdict of that. `beside` are failures
    found before, between and after the sequences, as case and reason. `broken` is true where the
    kit or the port failed. `seen` are facets of the look, in words. Of `sent`, `flaky` also counts
    what came between the sequences; on a line that loses nothing (`lossless`) it is the device's.
    """

    protocol: Protocol
    device: str
    link: dict[str, object]
    seed: int
    steps: tuple[Step, ...]
    lossless: bool
    machine: Mealy[Output] | None = None
    expected_states: int = 0
    differences: tuple[Difference, ...] = ()
    more: bool = False
    choices: tuple[tuple[str, str, str], ...] = ()
    beside: tuple[tuple[str, str], ...] = ()
    trouble: str = ""
    broken: bool = False
    seen: tuple[str, ...] = ()
    sent: Sent = field(default_factory=Sent)

    @property
    def names(self) -> tuple[str, ...]:
        """The inputs in words."""
        return tuple(name_of(self.protocol, step) for step in self.steps)

    @property
    def verdict(self) -> Verdict:
        """The verdict, from what was found. What was never seen is no pass."""
        if self.differences or self.beside or (self.sent.flaky and self.lossless):
            return Verdict.FAIL
        if self.broken:
            return Verdict.ERROR
        unsure = self.trouble or self.sent.flaky or not self.seen
        return Verdict.INCONCLUSIVE if unsure else Verdict.PASS

    @property
    def exit(self) -> int:
        """The exit code: 0 the same machine, 1 another, 2 the kit failed, 3 not all is known."""
        return exit_code([self.verdict])

    def send_line(self, difference: Difference) -> str:
        """The command that sends the sequence of a difference, from rest.

        The frames for the simulator or an emulated board go to `PORT`, where it is served.
        """
        protocol = self.protocol
        frames = (*reset(protocol), *self.frames_of(difference.word))
        items = [item_of(protocol, frame) for frame in frames]
        return shlex.join([*send_words(protocol.origin, self.device, self.link), *items])

    def frames_of(self, word: bytes) -> tuple[bytes, ...]:
        """The frames of a sequence of inputs."""
        return tuple(self.steps[letter].frame for letter in word)


class Unusable(UserError):
    """The line cannot be used at all; the message says why, in one sentence."""


def learn_target(
    target: Target,
    *,
    seed: int = 1,
    progress: Callable[[int, int], None] = lambda states, frames: None,
) -> Learned:
    """Learn a target and compare it with the Protocol's machine; the robot is stopped at the end.

    `seed` makes the random sequences that the machine must pass. `progress` is called with the
    states known and the frames sent so far. Raises Unusable, and NoAALpy where it is missing.
    """
    protocol, environment = target.protocol, target.environment
    steps = alphabet(protocol)
    lossless = environment.lossless
    learned = Learned(protocol, environment.device, environment.link, seed, steps, lossless)
    timers = timers_of(environment, protocol)
    config = RunConfig(
        protocol,
        timers.due_within(int(protocol.timing.answer_deadline * MS)),
        environment.observability,
        environment.power,
        environment.virtual,
        lossless,
    )
    run = Run(config, Profile(choices=Choices()))

    def afterwards() -> Procedure[None]:
        try:
            yield from _measure_stop(run)
            _learn(run, link, target.interrupted, learned, progress)
        except (GaveUp, NotLearned) as why:
            learned.trouble = str(why)

    try:
        link = target.connect(None)
        runner = Runner(run, (), afterwards=afterwards)
        drive(runner.execute(), link, target.interrupted)
    except BaseException:
        target.halt()
        raise
    if runner.unusable:
        raise Unusable(runner.unusable)
    ended = runner.ended
    if ended and not learned.trouble and (ended.error or learned.machine is None):
        learned.trouble, learned.broken = str(ended), ended.error
    failed = (one for one in run.results if one.verdict is Verdict.FAIL)
    learned.beside = tuple((one.id, one.reason) for one in failed)
    return learned


def _measure_stop(run: Run) -> Procedure[None]:
    """Measure how long after its answer to a fault the robot stops, where that can be seen."""
    if not (run.config.observable and run.profile.moves):
        return
    fault = next(step for step in alphabet(run.protocol) if step.faulty and not step.truncated)
    yield from set_up(run, in_motion(run.protocol, min(run.profile.moves)))
    yield from send(fault.frame)
    heard = yield from run.waiting.answers(1)
    seen = yield from watch(run, moving=False, patience=run.timers.deadline)
    late = seen.now - heard.now
    if seen.look.moving is False and late > run.timers.grace:
        run.profile.stop_latency = late
    yield from home(run)


def _learn(
    run: Run,
    link: Link,
    interrupted: Callable[[], bool | str],
    learned: Learned,
    progress: Callable[[int, int], None],
) -> None:
    """Learn the device, and fill in what came of it, however it ends."""
    choices, begun = run.profile.choices, len(run.results)
    learned.choices = tuple(
        (point, choices.word(point), verdict_of(point, choices.word(point)).label)
        for point in sorted(choices.others)
    )
    reference = reference_machine(Model(run.protocol, choices), learned.steps)
    system = System(run, link, interrupted, learned.steps, reference, learned.sent)
    system.progress = lambda frames: progress(learner.states, frames)
    learner = Learner(system, reference, seed=learned.seed)
    try:
        learned.machine = machine = learner.learn()
        learned.differences, learned.more = tuple(learner.differences), learner.more
        outputs = [output for row in machine.outputs for output in row]
        hidden = {one for one in FACETS if all(getattr(o, one) is None for o in outputs)}
        told = (facet for facet in FACETS if facet not in hidden)
        learned.seen = tuple(facet_words(run.protocol, facet) for facet in told)
        learned.expected_states = len(minimal(seen_without(reference, hidden)))
    finally:
        if learned.machine is None and system.deviation:
            learned.differences = (system.deviation,)
        run.strays.close(keeps_all=run.keeps_all)
        if not learned.lossless:
            # In so many sequences noise makes as many strays as fail a run of the suite.
            learned.sent.flaky += len(run.results) - begun
            del run.results[begun:]
