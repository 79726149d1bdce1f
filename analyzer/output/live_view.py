"""Lays out the live view, with a drawing of the car, from one frozen value; uses no clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.layout import Layout
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bilprov.analyzer.decode.records import (
    Anomaly,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    Severity,
    is_frame,
    severity_of,
)
from bilprov.analyzer.output.statistics import Latencies, Snapshot
from bilprov.analyzer.output.text_lines import SEVERITY_COLOURS
from bilprov.captures.schemas import State
from bilprov.captures.text import printable
from bilprov.spec.motion import Motion, wheels
from bilprov.spec.motion import State as MotionState
from bilprov.spec.protocol import FieldSpec, Protocol

SIDE_WIDTH = 30
FAULT_ROWS = 4


@dataclass(frozen=True, slots=True)
class View:
    """The content of the live view: `title` names the ports, `captured` what was recorded."""

    protocol: Protocol
    snapshot: Snapshot
    title: str
    captured: str = ""


def live_view(view: View) -> RenderableType:
    """Lay out a view. It fills the console it is drawn on, from 80 x 24 characters up."""
    layout = Layout()
    layout.split_column(
        Layout(_head(view), size=1),
        Layout(name="body"),
        Layout(_faults(view.snapshot), size=FAULT_ROWS + 2),
    )
    layout["body"].split_row(Layout(name="frames"), Layout(name="side", size=SIDE_WIDTH))
    layout["frames"].update(_Frames(view.snapshot.recent))
    layout["side"].split_column(
        Layout(Panel(_car(view.protocol, view.snapshot.state), title="predicted"), size=10),
        Layout(Panel(_numbers(view.snapshot), title="line")),
    )
    return layout


def _head(view: View) -> RenderableType:
    elapsed = view.snapshot.t / 1e9
    captured = f"  ● {printable(view.captured)}" if view.captured else ""
    right = Text(f"{captured}  {elapsed // 60:02.0f}:{elapsed % 60:04.1f}", no_wrap=True)
    bar = Table.grid(expand=True)
    bar.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    bar.add_column(no_wrap=True, width=right.cell_len)  # a long title is cut, the clock never
    bar.add_row(Text.assemble(("bilprov ", "bold"), printable(view.title)), right)
    return bar


class _Frames:
    """The panel of the last records, as many as fit, the newest at the bottom."""

    def __init__(self, records: tuple[Record, ...]) -> None:
        self._records = records

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        room = max(1, (options.height or console.height) - 2)
        table = Table.grid(padding=(0, 1, 0, 0), expand=True)
        for justify, ratio in (("right", None), ("left", None), ("left", None), ("left", 1)):
            table.add_column(justify=justify, ratio=ratio, no_wrap=True, overflow="ellipsis")  # type: ignore[arg-type]
        for record in self._records[-room:]:
            table.add_row(*_cells(record))
        yield Panel(table, title="frames", height=options.height)


def _cells(record: Record) -> tuple[Text, ...]:
    sign, hex_text, words, reason = _SHOWN[type(record)](record)
    if len(hex_text) > 11:
        hex_text = f"{hex_text[:8]} …"
    style = _style(record)
    return (
        Text(f"{record.t / 1e9:.6f}", "dim"),
        Text(sign, "bold cyan" if sign == "→" else "bold"),
        Text(hex_text, style),
        Text.assemble((printable(words), style), (f"  {printable(reason)}", "dim")),
    )


def _device_words(record: DeviceRecord) -> str:
    latency = record.latency
    return record.words + ("" if latency is None else f"  {latency / 1e6:.3f} ms")


# The sign, the bytes in hex, the words and the reason of each kind of record.
_SHOWN: dict[type[Record], Callable[[Any], tuple[str, str, str, str]]] = {
    HostRecord: lambda r: ("→", r.hex, r.words, r.reason),
    DeviceRecord: lambda r: ("←", r.hex, _device_words(r), r.reason),
    LineRecord: lambda r: ("-", "", f"{r.value.event} {r.value.detail}", ""),
    FaultRecord: lambda r: ("!", "", r.fault.kind, r.fault.reason),
}


def _style(record: Record) -> str:
    severity = severity_of(record)
    if severity is not None and severity > Severity.INFO:
        return SEVERITY_COLOURS[severity]
    return "green" if is_frame(record) else ""


def _faults(snapshot: Snapshot) -> RenderableType:
    counts = "  ".join(f"{kind} {count}" for kind, count in snapshot.faults)
    rows = [_fault(fault) for fault in snapshot.recent_faults[-FAULT_ROWS:]]
    if not rows:
        rows = [Text("none so far", "dim")]
    return Panel(
        Group(*rows), title=f"faults  {counts}" if counts else "faults", title_align="left"
    )


def _fault(fault: Anomaly) -> Text:
    line = Text(no_wrap=True, overflow="ellipsis")
    line.append(f"{fault.t / 1e9:.6f} ", "dim")
    line.append(fault.kind, f"bold {SEVERITY_COLOURS[fault.severity]}")
    return line.append(f"  {printable(fault.reason)}")


def _numbers(snapshot: Snapshot) -> RenderableType:
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    frames = f"{snapshot.instructions} → {snapshot.responses} ←"
    for label, words in (
        ("frames", f"{frames} {snapshot.frame_rate:.0f}/s"),
        ("host", f"{snapshot.byte_rates[0]:.0f} B/s {snapshot.loads[0]:.0%}"),
        ("device", f"{snapshot.byte_rates[1]:.0f} B/s {snapshot.loads[1]:.0%}"),
        *_latency(snapshot.latencies),
    ):
        table.add_row(label, words)
    return table


def _latency(latencies: Latencies | None) -> tuple[tuple[str, str], ...]:
    if latencies is None:
        return (("latency", "none yet"),)
    values = (latencies.median / 1e6, latencies.ninety_fifth / 1e6, latencies.longest / 1e6)
    median, most, longest = (f"{ms:.3g}" if abs(ms) < 100 else f"{ms:.0f}" for ms in values)
    return (("latency", f"{median} ms median"), ("", f"{most} 95 %, {longest} max"))


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


def _car(protocol: Protocol, state: State) -> RenderableType:
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
