"""The machine of the Protocol over the same inputs, with the choices that a device has shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bilprov.captures.schemas import Look
from bilprov.conformance.cases.preamble import frame_effect_of
from bilprov.conformance.cases.steps import Step
from bilprov.conformance.learning.alphabet import reset
from bilprov.conformance.learning.machine import Machine, explored
from bilprov.conformance.learning.output import Output, output_of
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.spec.motion import wheels


def reference_machine(model: Model, steps: Sequence[Step]) -> Machine:
    """The machine that a device must be which makes the model's choices; it may not be minimal.

    Facets of an output that the model does not know are None.
    """
    protocol = model.protocol
    start = model.homed(model.found())
    for frame in reset(protocol):
        start = model.after(start, frame_effect_of(protocol, frame))

    def step(before: ExpectedState, letter: int) -> tuple[ExpectedState, Output]:
        one = steps[letter]
        after = replace(model.after(before, one.frame_effect), rests_on=frozenset())
        return after, _expected(model, one, after)

    return explored(replace(start, rests_on=frozenset()), len(steps), step)


def _expected(model: Model, step: Step, after: ExpectedState) -> Output:
    word = model.choices.word(step.point) if step.point else ""
    accepted = next((one for one in step.accepted if one.word == word), step.accepted[0])
    state, unknown = after.state, after.unknown
    full = max(abs(end) for end in model.protocol.limits.get("steering", (0, 0)))
    left, right = wheels(state, full)
    motion = state.visible_motion.value
    look = Look(t=0, moving=state.moving, motion=motion, led=state.led, left=left, right=right)
    output = output_of(accepted.codes, look)
    if "speed" in unknown and not after.still:
        output = output._replace(moving=None, motion=None, ahead=None)
    if "motion" in unknown:
        output = output._replace(motion=None, ahead=None)
    if "steering" in unknown:
        output = output._replace(ahead=None)
    return output._replace(led=None) if "led" in unknown else output
