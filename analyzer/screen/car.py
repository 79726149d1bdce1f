"""Draws the predicted state of the car in eight rows: the car from above, then its settings."""

from __future__ import annotations

from rich.text import Text

from bilprov.analyzer.screen.signs import Signs
from bilprov.captures.schemas import State
from bilprov.spec.motion import Motion, wheels
from bilprov.spec.motion import State as MotionState
from bilprov.spec.protocol import FieldSpec, Protocol
from bilprov.spec.tables import MOTIONS

WIDTH = 26
ROWS = 8
_BAR = 14
# Screen colours for the letters of a colour field; other letters are shown in yellow.
_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def car(protocol: Protocol, state: State, signs: Signs) -> list[Text]:
    """The rows of the picture, at most 26 columns wide."""
    motion = Motion(state.motion)
    full = max((abs(end) for end in protocol.limits.get("steering", (0, 0))), default=0)
    moved = MotionState(motion, state.speed, state.steering, state.led)
    left, right = wheels(moved, full)
    colour = "bold green" if state.moving else "dim"
    sign = signs.motions[MOTIONS.index(motion)]
    front, side, back = signs.body
    axle = (_turning(left, signs), _turning(right, signs))
    return [
        Text(front.join(axle).center(WIDTH)),
        Text.assemble(f"{side:>9}   ", (sign, colour), f"   {side}"),
        Text(back.join(axle).center(WIDTH)),
        Text(_caption(state).center(WIDTH), colour),
        Text(f"wheels {left:+d} {right:+d}".center(WIDTH), "dim"),
        _speed(protocol, state.speed, signs),
        _steering(full, state.steering, signs),
        _led(protocol, state.led, signs),
    ]


def _turning(speed: int, signs: Signs) -> str:
    if speed == 0:
        return signs.wheel_still
    return signs.wheel_forward if speed > 0 else signs.wheel_backward


def _caption(state: State) -> str:
    words = state.motion.replace("_", " ")
    return words if state.moving or state.motion == Motion.STOPPED else f"{words}, speed 0"


def _speed(protocol: Protocol, speed: int, signs: Signs) -> Text:
    most = max(protocol.limits.get("speed", (0, 0))) or 1
    filled = round(_BAR * speed / most)
    rest = signs.bar_rest * (_BAR - filled)
    return Text.assemble(
        ("speed ", "dim"), (signs.bar * filled, "green"), (rest, "dim"), f" {speed}"
    )


def _steering(full: int, steering: int, signs: Signs) -> Text:
    half = _BAR // 2
    place = half + round(half * steering / (full or 1))
    track = [signs.track] * (_BAR + 1)
    track[half] = signs.track_middle
    track[place] = signs.knob
    return Text.assemble(("steer ", "dim"), "".join(track), f" {steering:+d}")


def _led(protocol: Protocol, led: int, signs: Signs) -> Text:
    line = Text.assemble(("led   ", "dim"))
    bits = _led_bits(protocol)
    for at, name in enumerate(bits):
        on = bool(led >> (len(bits) - 1 - at) & 1)
        colour = f"bold {_COLOURS.get(name, 'yellow')}"
        line.append(signs.lit if on else signs.unlit, colour if on else "dim")
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
