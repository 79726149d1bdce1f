"""What frames make a robot do: the kinds of motion, and the greatest speed that they set."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from bilprov.spec.codec import judge
from bilprov.spec.motion import Motion, State, rotates
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True, slots=True)
class Movement:
    """What frames make a robot do; `speed` is the greatest that is set, None if none is."""

    motions: frozenset[Motion] = frozenset()
    speed: int | None = None

    def __or__(self, other: Movement) -> Movement:
        """What both make it do."""
        speeds = [speed for speed in (self.speed, other.speed) if speed is not None]
        return Movement(self.motions | other.motions, max(speeds, default=None))


def all_movement(protocol: Protocol) -> Movement:
    """What the instructions of a protocol can make a robot do."""
    motions = {spec.effect.motion for spec in protocol.instructions}
    speed = protocol.limits["speed"][1] if "speed" in protocol.limits else None
    return Movement(frozenset(m for m in motions if m not in (None, Motion.STOPPED)), speed)


def movement_of(protocol: Protocol, frames: Iterable[bytes]) -> Movement:
    """What these frames make a conforming robot do; faulty ones stop it.

    No more of them are taken once they do all that the protocol can.
    """
    every, found = all_movement(protocol), Movement()
    known: set[bytes] = set()
    for frame in frames:
        if frame in known:
            continue
        judged = judge(protocol, frame)
        if not judged.valid or judged.instruction is None:
            continue
        known.add(frame)
        effect = judged.instruction.effect
        after = effect.apply(State(), dict(judged.fields))
        found |= Movement(
            frozenset({after.motion} - {Motion.STOPPED}),
            after.speed if effect.sets("speed") else None,
        )
        if found == every:
            break
    return found


def movement_words(protocol: Protocol, movement: Movement) -> str:
    """What will move, how fast at most, and what to do before it does, in words."""
    kinds = {rotates(motion): motion for motion in movement.motions}
    verbs = [verb for turning, verb in ((False, "drives"), (True, "turns")) if turning in kinds]
    words = f"it {' and '.join(verbs)}" if verbs else "it is sent no motion"
    if "speed" in protocol.limits:
        fast = f"speeds up to {movement.speed} of {protocol.limits['speed'][1]}"
        if movement.speed is not None:
            words += f", at {fast}" if verbs else f", only {fast}"
        elif verbs:
            words += ", at the speed that it has"
    return f"{words}; its wheels should be off the ground"
