"""The machine of the Protocol over the same inputs, and how long it takes to learn it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from bilprov.captures.schemas import MS, look_class
from bilprov.conformance.cases.steps import Step, step_of
from bilprov.conformance.dut.target import Target
from bilprov.conformance.learning.alphabet import alphabet, reset
from bilprov.conformance.learning.output import FACETS, Output, output_of
from bilprov.conformance.machines.mealy import Mealy, explore, minimal
from bilprov.conformance.oracle.choices import Choices
from bilprov.conformance.oracle.profile import timers_of
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol

_OPENING = 10.0  # s for the link check, measurements and experiments
_LATENCY = MS // 2  # of an answer, and of a look
_ASKED, _LENGTH = 2.5, 5  # sequences that learning takes for each transition, and their inputs


def _shows(protocol: Protocol, variable: str) -> tuple[str, ...]:
    """The facets that depend on a variable; a robot that stands still shows no speed."""
    car = protocol.car
    depend = {car.speed: ("moving", "motion", "ahead"), car.by: ("motion", "ahead")}
    return {**depend, car.steering: ("ahead",)}.get(variable, ("lights",))


def reference_machine(model: Model, steps: Sequence[Step]) -> Mealy[Output]:
    """The machine that a device must be which makes the model's choices; it may not be minimal.

    Facets of an output that the model does not know are None.
    """
    protocol = model.protocol
    start = model.homed(model.found())
    for frame in reset(protocol):
        start = model.after(start, step_of(protocol, frame).frame_effect)

    def step(before: ExpectedState, letter: int) -> tuple[ExpectedState, Output]:
        one = steps[letter]
        after = replace(model.after(before, one.frame_effect), rests_on=frozenset())
        return after, _expected(model, one, after)

    return explore(replace(start, rests_on=frozenset()), len(steps), step)


def seen_without(machine: Mealy[Output], facets: Collection[str]) -> Mealy[Output]:
    """The machine with outputs that do not have these facets."""
    return Mealy(
        machine.targets, tuple(tuple(o.without(facets) for o in row) for row in machine.outputs)
    )


def estimated_seconds(target: Target) -> float:
    """About how long (s) it takes to learn a conforming device in place of the target."""
    protocol, steps = target.protocol, alphabet(target.protocol)
    looks = target.environment.observability.available
    settle = timers_of(target.environment, protocol).settle
    machine = reference_machine(Model(protocol, Choices()), steps)
    transitions = len(steps) * len(minimal(seen_without(machine, () if looks else FACETS)))

    def exchange(frame: bytes) -> int:
        return (len(frame) + 1) * target.byte_time + _LATENCY + target.latency

    each = sum(exchange(step.frame) for step in steps) / len(steps) + (
        _LATENCY if looks else settle
    )
    # A truncated frame is hardly ever but the last of a sequence.
    timeouts = (
        sum(step.truncated for step in steps) / len(steps) * protocol.timing.truncation_timeout
    )
    # Each stop of homing is answered while the next ones are sent.
    begin = exchange(bytes(protocol.longest_frame)) + settle + sum(map(exchange, reset(protocol)))
    return _OPENING + _ASKED * transitions * (begin + _LENGTH * each + timeouts * MS) / 1e9


def _expected(model: Model, step: Step, after: ExpectedState) -> Output:
    word = model.choices.word(step.point) if step.point else ""
    accepted = next((one for one in step.accepted if one.word == word), step.accepted[0])
    state, protocol = after.state, model.protocol
    left, right = protocol.car.wheels(state, protocol.full_steering)
    values = {name: getattr(state, name) for name in protocol.lights}
    values[protocol.car.by] = visible_motion(state)
    looks = look_class(protocol.state_type)
    look = looks(t=0, moving=state.moving, left=left, right=right, **values)
    unknown = after.unknown - {protocol.car.speed} if after.still else after.unknown
    hidden = (facet for variable in unknown for facet in _shows(protocol, variable))
    return output_of(protocol, accepted.codes, look).without(hidden)
