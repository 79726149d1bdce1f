"""Model of the expected state after each frame: the grammar's effects and the device's choices.

The document leaves some effects open. The model takes the choice that the device has shown for
each such point, so that a device that shows two choices contradicts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from bilprov.conformance.oracle.profile import Choices
from bilprov.spec.motion import MOTIONS, Moment
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import Behaviour, OpenPoint, open_after
from bilprov.spec.state import Effect, State


@dataclass(frozen=True, slots=True)
class FrameEffect:
    """The effect of a frame: an instruction's effect with its field values, or None for a fault."""

    effect: Effect | None
    values: Mapping[str, int] = field(default_factory=dict)


FAULT = FrameEffect(None)
NOTHING = FrameEffect(Effect())


@dataclass(frozen=True, slots=True)
class ExpectedState:
    """The state that the robot must be in, as far as it is known.

    `unknown` names the variables that are not known (and `curve`, if a rotation may have become
    one),
    `pending_speed` is a speed that counts only from the next motion on (R-speed-moving), `rests_on`
    are the open points at which a choice other than the default led to this state.
    """

    state: State
    unknown: frozenset[str] = frozenset()
    pending_speed: int | None = None
    rests_on: frozenset[str] = frozenset()

    @property
    def still(self) -> bool:
        """Whether the robot must stand still."""
        car = self.state.wheels
        return car.drive(self.state).motion not in car.turns


@dataclass(frozen=True, slots=True)
class Model:
    """The reference device's behaviour, with one device's choices at open points."""

    protocol: Protocol
    choices: Choices

    def found(self) -> ExpectedState:
        """The expected state of a robot at rest of which nothing else is known."""
        return ExpectedState(self.protocol.power_on, frozenset(self.protocol.settings))

    def homed(self, before: ExpectedState) -> ExpectedState:
        """The expected state after the Stop instructions that home the line."""
        return self.after(before, FrameEffect(self.protocol.stop.effect))

    def shows(self, state: State) -> bool:
        """Whether speed and steering are so large that a curve differs visibly from straight on."""
        _, fast = self.protocol.speeds
        _, speed, steering = self.protocol.car.drive(state)
        return bool(2 * speed > fast and 2 * abs(steering) > self.protocol.full_steering)

    def after(self, before: ExpectedState, frame_effect: FrameEffect) -> ExpectedState:
        """The expected state after a frame."""
        effect = frame_effect.effect or self.protocol.on_fault
        state = effect.apply(before.state, frame_effect.values)
        unknown = before.unknown
        if unknown:
            unknown -= {name for name, _ in effect.assignments}
        expected_state = ExpectedState(state, unknown, before.pending_speed, before.rests_on)
        if not self.choices.others and not self.choices.hidden:
            # The device reads the document as the kit does, and there is nothing to add.
            return expected_state
        car = self.protocol.car
        moment = car.moment(frame_effect.effect)
        if moment is Moment.SETTING:
            return self._set(expected_state, before, effect)
        if moment in MOTIONS and before.pending_speed is not None:
            speed = expected_state.state.but(**{car.speed: before.pending_speed})
            known = expected_state.unknown - {car.speed}
            expected_state = replace(expected_state, state=speed, unknown=known, pending_speed=None)
        for name, point in open_after(self.protocol, frame_effect.effect).items():
            if self.choices.unknown(point.id):
                open_now = expected_state.unknown | {name}
                expected_state = replace(expected_state, unknown=open_now)
            elif self.choices.differs(point.id):
                expected_state = self._otherwise(expected_state, before, name, point)
        return expected_state

    def _set(
        self, expected_state: ExpectedState, before: ExpectedState, effect: Effect
    ) -> ExpectedState:
        """The expected state after a setting: changed at once, unless the device chooses else."""
        car, unknown = self.protocol.car, self.choices.unknown
        was = car.drive(before.state)
        if effect.sets(car.speed):
            expected_state = replace(expected_state, pending_speed=None)
            speed = car.drive(expected_state.state).speed
            directed = not before.still
            if directed and unknown("R-speed-moving"):
                open_now = expected_state.unknown | {car.speed}
                expected_state = replace(expected_state, unknown=open_now, pending_speed=speed)
            elif directed and self.choices.differs("R-speed-moving"):
                state = expected_state.state.but(**{car.speed: was.speed})
                # Whether a direction without speed counts as moving is left open too.
                unsure = before.unknown if was.speed else {car.speed}
                open_now = expected_state.unknown | (unsure & {car.speed})
                rests_on = expected_state.rests_on | {"R-speed-moving"}
                expected_state = ExpectedState(state, open_now, speed, rests_on)
        if not effect.sets(car.steering) or not car.rotates(was.motion):
            return expected_state
        if unknown("R-steer-rotating"):
            open_now = expected_state.unknown | {car.by, "curve"}
            return replace(expected_state, unknown=open_now)
        if self.choices.differs("R-steer-rotating"):
            rests_on = expected_state.rests_on | {"R-steer-rotating"}
            expected_state = replace(
                expected_state, unknown=expected_state.unknown | {car.by}, rests_on=rests_on
            )
        return expected_state

    def _otherwise(
        self, expected_state: ExpectedState, before: ExpectedState, name: str, point: OpenPoint
    ) -> ExpectedState:
        """The expected state with the device's choice of a point: a variable is kept or reset."""
        value, unknown = 0, expected_state.unknown - {name}
        changed = name in expected_state.unknown
        if self.choices.word(point.id) == point.word_of(Behaviour.KEPT):
            value, unknown = getattr(before.state, name), unknown | (before.unknown & {name})
            changed = False
        changed |= getattr(expected_state.state, name) != value
        pending_speed = None if name == self.protocol.car.speed else expected_state.pending_speed
        rests_on = expected_state.rests_on | ({point.id} if changed else set())
        state = expected_state.state.but(**{name: value})
        return ExpectedState(state, unknown, pending_speed, rests_on)
