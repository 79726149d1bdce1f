"""Draws the predicted state of the car: direction, wheels, speed, steering and LED."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from bilprov.captures.schemas import State
from bilprov.spec.motion import Motion, wheels
from bilprov.spec.motion import State as MotionState
from bilprov.spec.protocol import FieldSpec, Protocol

BAR = 14
_ARROWS = {
    Motion.STOPPED: "■",
    Motion.FORWARD: "▲",
    Motion.BACKWARD: "▼",
    Motion.ROTATE_RIGHT: "↻",
    Motion.ROTATE_LEFT: "↺",
}
# Screen colours for the letters of a colour field; other letters are shown in yellow.
_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def car_view(protocol: Protocol, state: State) -> RenderableType:
    """Draw the state in eight rows of 26 columns: the car from above, then its settings."""
    motion = Motion(state.motion)
    full = max((abs(end) for end in protocol.limits.get("steering", (0, 0))), default=0)
    moved = MotionState(motion, state.speed, state.steering, state.led)
    left, right = wheels(moved, full)
    colour = "bold green" if state.moving else "dim"
    sign = _ARROWS[motion]
    rows = [
        Text.assemble(f"{_turning(left)}┌───────┐{_turning(right)}".center(24)),
        Text.assemble("       │   ", (sign, colour), "   │"),
        Text.assemble(f"{_turning(left)}└───────┘{_turning(right)}".center(24)),
        Text(_caption(state).center(24), colour),
        Text(f"wheels {left:+d} {right:+d}".center(24), "dim"),
        _speed(protocol, state.speed),
        _steering(full, state.steering),
        _led(protocol, state.led),
    ]
    return Group(*rows)


def _turning(speed: int) -> str:
    return "▲" if speed > 0 else "▼" if speed < 0 else "▪"


def _caption(state: State) -> str:
    words = state.motion.replace("_", " ")
    return words if state.moving or state.motion == Motion.STOPPED else f"{words}, speed 0"


def _speed(protocol: Protocol, speed: int) -> Text:
    most = max(protocol.limits.get("speed", (0, 0))) or 1
    filled = round(BAR * speed / most)
    return Text.assemble(
        ("speed ", "dim"), ("█" * filled, "green"), ("░" * (BAR - filled), "dim"), f" {speed}"
    )


def _steering(full: int, steering: int) -> Text:
    half = BAR // 2
    place = half + round(half * steering / (full or 1))
    track = ["─"] * (BAR + 1)
    track[half] = "┼"
    track[place] = "●"
    return Text.assemble(("steer ", "dim"), "".join(track), f" {steering:+d}")


def _led(protocol: Protocol, led: int) -> Text:
    line = Text.assemble(("led   ", "dim"))
    bits = _led_bits(protocol)
    for at, name in enumerate(bits):
        on = bool(led >> (len(bits) - 1 - at) & 1)
        line.append("●" if on else "○", f"bold {_COLOURS.get(name, 'yellow')}" if on else "dim")
        line.append(f" {name}  ", "" if on else "dim")
    return line if bits else line.append(str(led))


def _led_bits(protocol: Protocol) -> str:
    """The letters of the LED's bits, from the field that sets the LED; empty if it has none."""
    for spec in protocol.instructions:
        for variable, value in spec.effect.assignments:
            if variable == "led" and isinstance(value, tuple):
                fields: dict[str, FieldSpec] = {part.name: part for part in spec.fields}
                return fields[value[0]].bits
    return ""
