"""What a robot must be like after each frame: the grammar's effects and the device's own choices.

The document leaves some effects open. The model takes the choice that the device has shown for
each such point, so that a device that shows two choices contradicts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from conformance.oracle.choices import Choices
from spec.motion import WHEELS, Effect, Motion, State
from spec.protocol import Protocol

VARIABLES = ("speed", "steering", "led")


@dataclass(frozen=True, slots=True)
class Deed:
    """What a frame does: an instruction's effect with its field values, or a fault (None)."""

    effect: Effect | None
    values: Mapping[str, int] = field(default_factory=dict)

    @property
    def stops(self) -> bool:
        """Whether it is an instruction that stops."""
        return self.effect is not None and self.effect.motion is Motion.STOPPED


FAULT = Deed(None)
NOTHING = Deed(Effect())


@dataclass(frozen=True, slots=True)
class Belief:
    """What the robot must be like.

    `loose` names what cannot be said of it (of speed, steering, led, motion), `waiting` is a speed
    that counts only from the next motion on (R-speed-moving), `rests` are the points whose other
    choice shaped it.
    """

    state: State
    loose: frozenset[str] = frozenset()
    waiting: int | None = None
    rests: frozenset[str] = frozenset()

    @property
    def still(self) -> bool:
        """Whether the robot must stand still."""
        return self.state.motion is Motion.STOPPED


@dataclass(frozen=True, slots=True)
class Model:
    """The reference's behaviour with one device's choices."""

    protocol: Protocol
    choices: Choices

    def found(self) -> Belief:
        """A robot at rest of which nothing else is known."""
        return Belief(self.protocol.power_on, frozenset(VARIABLES))

    def homed(self, before: Belief) -> Belief:
        """After the stops that home the line."""
        return self.after(before, Deed(self.protocol.stop.effect))

    def shows(self, state: State) -> bool:
        """Whether speed and steering are large enough for a curve to be told from straight on."""
        _, fast = self.protocol.limits.get("speed", (0, 0))
        full = max(abs(end) for end in self.protocol.limits.get("steering", (0, 0)))
        return 2 * state.speed > fast and 2 * abs(state.steering) > full

    def after(self, before: Belief, deed: Deed) -> Belief:
        """What the robot must be like after a frame."""
        effect = deed.effect or self.protocol.on_fault
        state = effect.apply(before.state, deed.values)
        loose = before.loose
        if loose:
            loose -= {name for name, _ in effect.assignments}
        belief = Belief(state, loose, before.waiting, before.rests)
        if not self.choices.others:
            # The device reads the document as the kit does, and there is nothing to add.
            return belief
        if deed.effect is None:
            belief = self._reset(belief, "speed", "R-fault-state speed", "zeroed")
            belief = self._kept(belief, before, "R-fault-state steering")
            return self._reset(belief, "led", "R-led-state fault", "off")
        if effect.motion is Motion.STOPPED:
            belief = self._reset(belief, "speed", "R-stop-speed", "zeroed")
            belief = self._kept(belief, before, "R-stop-steering")
            return self._reset(belief, "led", "R-led-state stop", "off")
        if effect.motion is not None:
            if before.waiting is not None:
                speed = replace(belief.state, speed=before.waiting)
                known = belief.loose - {"speed"}
                belief = replace(belief, state=speed, loose=known, waiting=None)
            return self._reset(belief, "steering", "R-drive-steering", "straight")
        return self._set(belief, before, effect)

    def _set(self, belief: Belief, before: Belief, effect: Effect) -> Belief:
        """Settings change what they name at once, unless the device has chosen otherwise."""
        if effect.sets("speed"):
            belief = replace(belief, waiting=None)
            directed = before.state.motion is not Motion.STOPPED
            if directed and self.choices.is_other("R-speed-moving"):
                waiting = belief.state.speed
                state = replace(belief.state, speed=before.state.speed)
                # Whether a direction without speed counts as moving is left open too.
                unsure = before.loose if before.state.speed else {"speed"}
                loose = belief.loose | (unsure & {"speed"})
                rests = belief.rests | {"R-speed-moving"}
                belief = Belief(state, loose, waiting, rests)
        curves = self.choices.is_other("R-steer-rotating")
        if curves and effect.sets("steering") and rotates(before.state):
            rests = belief.rests | {"R-steer-rotating"}
            belief = replace(belief, loose=belief.loose | {"motion"}, rests=rests)
        return belief

    def _reset(self, belief: Belief, name: str, point: str, word: str) -> Belief:
        if self.choices.word(point) != word:
            return belief
        changed = getattr(belief.state, name) != 0 or name in belief.loose
        state = replace(belief.state, **{name: 0})  # type: ignore[arg-type]  # never the motion
        rests = belief.rests | ({point} if changed else set())
        waiting = None if name == "speed" else belief.waiting
        return Belief(state, belief.loose - {name}, waiting, rests)

    def _kept(self, belief: Belief, before: Belief, point: str) -> Belief:
        if self.choices.word(point) != "kept":
            return belief
        changed = belief.state.steering != before.state.steering
        state = replace(belief.state, steering=before.state.steering)
        loose = belief.loose | (before.loose & {"steering"})
        rests = belief.rests | ({point} if changed else set())
        return replace(belief, state=state, loose=loose, rests=rests)


def rotates(state: State) -> bool:
    """Whether the kind of motion turns the wheels against each other."""
    left, right = WHEELS[state.motion]
    return left != right
