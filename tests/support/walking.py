"""Builds sequences by hand and runs single ones, for the tests of sequences and retries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bilprov.analyzer.client.operations import Procedure, drive, followed
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import Step, step_of
from bilprov.conformance.dut.simulator import Event, Fault, React, Reaction
from bilprov.conformance.dut.target import Observability
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.runner.homing import home, home_after, see_motions
from bilprov.conformance.runner.run import Run, Trial
from bilprov.conformance.runner.sequence import Mismatch, run_sequence
from bilprov.spec.protocol import Protocol
from tests.support.robots import ALL_SEEING, MS, CountingLink, new_run

CLAUSE, REQUIREMENT = "the walk's own clause", "the walk's own requirement"
SAFETY, INSTRUCTIONS, RESPONSES = "section 2", "section 3, table 1", "section 4, table 2"


def step(protocol: Protocol, hexed: str) -> Step:
    """A frame in hex as a step; one that is shorter than it announces is cut."""
    return step_of(protocol, bytes.fromhex(hexed))


def burst(protocol: Protocol, *frames: str, **more: Any) -> Burst:
    return Burst(tuple(step(protocol, frame) for frame in frames), **more)


def hand_made(
    protocol: Protocol, *bursts: Burst | str, setup: tuple[str, ...] = ()
) -> SequenceCase:
    """A walk of bursts; a frame in hex is a burst of its own."""
    made = tuple(b if isinstance(b, Burst) else burst(protocol, b) for b in bursts)
    before = tuple(step(protocol, frame) for frame in setup)
    return SequenceCase("sequence/hand-made", CLAUSE, REQUIREMENT, before, made)


def at_frame(hexed: str, change: React) -> Fault:
    """A device that reacts otherwise to one frame, and behaves well else."""
    frame = bytes.fromhex(hexed)

    def react(device: Any, event: Event, reaction: Reaction) -> Reaction:
        return change(device, event, reaction) if event.judgement.frame == frame else reaction

    return Fault("x", "test", "", react=react)


@dataclass
class Walked:
    """What came of walking once: run and trial, what went wrong, and the case's result."""

    run: Run
    trial: Trial
    mismatch: Mismatch | None
    result: CaseResult
    link: CountingLink

    @property
    def wrong(self) -> Mismatch:
        """What went wrong; fails where nothing did."""
        assert self.mismatch is not None
        return self.mismatch


def run_once(
    device: Any,
    protocol: Protocol,
    case: SequenceCase,
    *,
    observability: Observability = ALL_SEEING,
    timers: Timers | None = None,
    profile: Profile | None = None,
    link: type[CountingLink] = CountingLink,
) -> Walked:
    """Home, walk, and home again, which makes the result final."""
    line = link(device)
    known = profile or Profile(truncation_timeout=50 * MS)
    run = new_run(protocol, timers=timers, observability=observability, profile=known)

    def script() -> Procedure[Walked]:
        yield from home(run)
        yield from see_motions(run)
        trial = Trial(run, case)
        found = yield from run_sequence(trial, case)
        homed = yield from home_after(run, trial)
        return Walked(run, trial, found, trial.end(homed), line)

    return drive(followed(script(), run.sight), line, lambda: False)
