"""Draws the predicted state of the car in eight rows: the car from above, then its settings."""

from __future__ import annotations

from rich.text import Text

from bilprov.captures.schemas import State
from bilprov.spec.data import FieldSpec
from bilprov.spec.motion import Motion, wheels
from bilprov.spec.motion import State as MotionState
from bilprov.spec.protocol import Protocol
from bilprov.spec.tables import MOTIONS

WIDTH = 26
ROWS = 8
_BAR = 14
_SIGNS = "■▲▼↻↺"  # one for each Motion, in their order
# Screen colours for the letters of a colour field; other letters are shown in yellow.
_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def car(protocol: Protocol, state: State) -> list[Text]:
    """The rows of the picture, at most 26 columns wide."""
    motion = Motion(state.motion)
    full = max((abs(end) for end in protocol.limits.get("steering", (0, 0))), default=0)
    moved = MotionState(motion, state.speed, state.steering, state.led)
    left, right = wheels(moved, full)
    style = "bold" if state.moving else "dim"
    sign = _SIGNS[MOTIONS.index(motion)]
    axle = (_turning(left), _turning(right))
    return [
        Text("┌───────┐".join(axle).center(WIDTH)),
        Text.assemble("        │   ", (sign, style), "   │"),
        Text("└───────┘".join(axle).center(WIDTH)),
        Text(_caption(state).center(WIDTH), style),
        Text(f"wheels {left:+d} {right:+d}".center(WIDTH), "dim"),
        _speed(protocol, state.speed),
        _steering(full, state.steering),
        _led(protocol, state.led),
    ]


def _turning(speed: int) -> str:
    return "▲" if speed > 0 else "▼" if speed else "▪"


def _caption(state: State) -> str:
    words = state.motion.replace("_", " ")
    return words if state.moving or state.motion == Motion.STOPPED else f"{words}, speed 0"


def _speed(protocol: Protocol, speed: int) -> Text:
    most = max(protocol.limits.get("speed", (0, 0))) or 1
    filled = round(_BAR * speed / most)
    rest = "░" * (_BAR - filled)
    return Text.assemble(("speed ", "dim"), "█" * filled, (rest, "dim"), f" {speed}")


def _steering(full: int, steering: int) -> Text:
    half = _BAR // 2
    place = half + round(half * steering / (full or 1))
    track = ["─"] * (_BAR + 1)
    track[half] = "┼"
    track[place] = "●"
    return Text.assemble(("steer ", "dim"), "".join(track), f" {steering:+d}")


def _led(protocol: Protocol, led: int) -> Text:
    line = Text.assemble(("led   ", "dim"))
    bits = _led_bits(protocol)
    for at, name in enumerate(bits):
        on = bool(led >> (len(bits) - 1 - at) & 1)
        colour = f"bold {_COLOURS.get(name, 'yellow')}"
        line.append("●" if on else "○", colour if on else "dim")
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
