"""A single-frame test case as a value: start state, stimulus, accepted answers, expected state."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bilprov.conformance.cases.steps import FrameClass, Step
from bilprov.conformance.oracle.state_model import FAULT, NOTHING, FrameEffect
from bilprov.conformance.oracle.verdicts import Accepted
from bilprov.spec.motion import State
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Case:
    """A test case that sends one stimulus in a given state and judges the answer and the state.

    `setup` is the state the robot is brought to (and, where it moves, seen to move in) before
    `stimulus` is sent; `accepted` are the answer lists that may come back, the expected one
    first; `frame_effect` is what the stimulus does, `expected` the reference's state after it, and
    `stop` whether the case tests that the robot stands still. `arrived` is None for complete
    frames, else the number of data bytes that are sent before the line falls silent. `then` is a
    valid frame that must work right after the stimulus, `after_then` the reference's state after
    it. `point` is the open point of the document that the answer rests on. `short` frames announce
    less data than the instruction takes: a device must not take the next byte for its data.
    `thorough` cases watch the stop longer; where looks are costly, only they are observed.
    """

    id: str
    clause: str
    requirement: str
    setup: State
    stimulus: bytes
    accepted: tuple[Accepted, ...]
    expected: State
    stop: bool
    kind: FrameClass
    frame_effect: FrameEffect = FAULT
    reading: str = ""
    point: str = ""
    arrived: int | None = None
    then: bytes = b""
    after_then: State | None = None
    short: bool = False
    thorough: bool = False

    @property
    def step(self) -> Step:
        """The stimulus as a step."""
        return Step(
            self.stimulus,
            self.kind,
            self.accepted,
            self.frame_effect,
            self.clause,
            self.point,
            self.reading,
            self.arrived is not None,
        )

    def as_step(self, step: Step) -> Case:
        """The case with another step in place of its stimulus."""
        return replace(
            self,
            stimulus=step.frame,
            kind=step.kind,
            accepted=step.accepted,
            frame_effect=step.frame_effect,
            point=step.point,
            arrived=len(step.frame) - 1 if step.truncated else None,
            stop=self.stop and step.faulty if self.step.faulty else self.stop or step.faulty,
        )

    @property
    def sent(self) -> tuple[bytes, ...]:
        """The frames under test: the stimulus and, if there is one, `then`; not the preamble."""
        return (self.stimulus, self.then) if self.then else (self.stimulus,)


def runner_case(
    protocol: Protocol,
    ident: str,
    clause: str,
    requirement: str,
    stimulus: bytes,
    reading: str = "",
) -> Case:
    """A case that a procedure of the runner carries out; it states no answers or effect."""
    return Case(
        id=ident,
        clause=clause,
        requirement=requirement,
        setup=protocol.power_on,
        stimulus=stimulus,
        accepted=(),
        expected=protocol.power_on,
        stop=False,
        kind=FrameClass.VALID,
        frame_effect=NOTHING,
        reading=reading,
    )
