"""Draws the predicted state in eight rows: a car from above with its settings, or the variables."""

from __future__ import annotations

from rich.text import Text

from bilprov.spec.motion import Wheels
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State, VariableSpec

WIDTH = 26
ROWS = 8
_BAR = 14
_SIGNS = {(1, 1): "▲", (-1, -1): "▼", (1, -1): "↻", (-1, 1): "↺"}  # by how the wheels turn
# Screen colours for the letters of a colour field; other letters are shown in yellow.
_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def picture(protocol: Protocol, state: State) -> list[Text]:
    """The rows of the picture, at most 26 columns wide."""
    if protocol.wheels:
        return [*_car(protocol, protocol.wheels, state), *_bits(protocol, state)][:ROWS]
    return [_variable(spec, getattr(state, spec.name)) for spec in protocol.variables.values()][
        :ROWS
    ]


def _car(protocol: Protocol, car: Wheels, state: State) -> list[Text]:
    full = max((abs(end) for end in protocol.limits.get(car.steering, (0, 0))), default=0)
    left, right = car.wheels(state, full)
    style = "bold" if state.moving else "dim"
    motion = getattr(state, car.by)
    sign = _SIGNS[car.turns[motion]] if motion in car.turns else "■"
    axle = (_turning(left), _turning(right))
    return [
        Text("┌───────┐".join(axle).center(WIDTH)),
        Text.assemble("        │   ", (sign, style), "   │"),
        Text("└───────┘".join(axle).center(WIDTH)),
        Text(_caption(motion, state.moving, motion in car.turns).center(WIDTH), style),
        Text(f"wheels {left:+d} {right:+d}".center(WIDTH), "dim"),
        _speed(protocol, car, getattr(state, car.speed)),
        _steering(full, getattr(state, car.steering)),
    ]


def _turning(speed: int) -> str:
    return "▲" if speed > 0 else "▼" if speed else "▪"


def _caption(motion: str, moving: bool, directed: bool) -> str:
    words = motion.replace("_", " ")
    return words if moving or not directed else f"{words}, speed 0"


def _speed(protocol: Protocol, car: Wheels, speed: int) -> Text:
    most = max(protocol.limits.get(car.speed, (0, 0))) or 1
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


def _bits(protocol: Protocol, state: State) -> list[Text]:
    """A row for each variable of bits."""
    specs = [spec for spec in protocol.variables.values() if spec.bits]
    return [_variable(spec, getattr(state, spec.name)) for spec in specs]


def _variable(spec: VariableSpec, value: int | str | None) -> Text:
    """A variable with its value; bits are lamps."""
    line = Text.assemble((f"{spec.name[:10]:<5} ", "dim"))
    if not spec.bits or value is None:
        return line.append("not known" if value is None else str(value))
    for at, name in enumerate(spec.bits):
        on = bool(int(value) >> (len(spec.bits) - 1 - at) & 1)
        colour = f"bold {_COLOURS.get(name, 'yellow')}"
        line.append("●" if on else "○", colour if on else "dim")
        line.append(f" {name}  ", "" if on else "dim")
    return line
