"""What the panes show: the line above and the line below, the figures, the predicted state."""

from __future__ import annotations

from rich.text import Text

from bilprov.analyzer.output.stats_tables import FEWEST, spark
from bilprov.analyzer.screen.feeds import Feed, Rates, Told
from bilprov.analyzer.screen.frame_list import FrameList
from bilprov.analyzer.screen.keys import BINDINGS, DEVICE_FAULT, HOST_FAULT, LINE_FAULT, RECORDS
from bilprov.analyzer.totals.totals import Totals
from bilprov.captures.text import printable, quantity
from bilprov.spec.motion import Wheels
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State, VariableSpec

_SIDES = {"host": HOST_FAULT, "device": DEVICE_FAULT, "": LINE_FAULT}
_LATE = 10  # columns of a latency, with a space before it
_KINDS = 4  # kinds of faults of each side that are named


def figures(totals: Totals, live: Rates | None, byte_time: int, width: int) -> list[Text]:
    """The lines. Rates are those of the last two seconds where they are those of a `live` line,
    else the mean over the recording. `byte_time` is ns a byte on the line.
    """
    seconds = ((totals.last or 0) - (totals.first or 0)) / 1e9 or 1.0
    rates = live or Rates(
        totals.frames / seconds, (totals.host_bytes / seconds, totals.device_bytes / seconds)
    )
    load = max(rates.bytes) * byte_time / 1e9
    counts = totals.rates.series("frames")
    lines = [Text(spark(counts, width))] if len(counts) >= FEWEST else []
    words = [quantity(totals.frames, "frame"), quantity(totals.answers, "answer")]
    per_second = quantity(round(rates.frames), "frame")
    words.append(f"{per_second}/s, {load:.0%} full")
    if spread := totals.latencies.spread():
        words.append(f"latency {_ms(spread.median)} ms")
        words.append(f"p95 {_ms(spread.p95)}, max {_ms(spread.max)} ms")
    lines += map(Text, words)
    for side, look in _SIDES.items():
        kinds = totals.faults_of(side)
        if kinds:
            whose = f"{look.sign} {kinds.total():,} from the {side or 'line'}"
            lines += [Text(), Text(whose, look.style)]
        for kind, count in kinds.most_common(_KINDS):
            lines.append(Text(f"  {kind}: {count:,}", "dim"))
    lines.append(Text())
    said = {name: said for name, said in totals.instructions().items() if said.frames}
    digits = max((len(f"{one.frames:,}") for one in said.values()), default=0)
    for name, one in said.items():
        late = f"{_ms(one.latencies.median)} ms" if one.latencies else ""
        line = Text(name, "dim")
        line.truncate(width - digits - _LATE - 1, overflow="ellipsis", pad=True)
        lines.append(line.append(f" {one.frames:>{digits},}{late:>{_LATE}}"))
    return lines


def _ms(t: int) -> str:
    ms = t / 1e6
    return f"{ms:.3g}" if abs(ms) < 100 else f"{ms:.0f}"


WIDTH = 26
ROWS = 8
_BAR = 14
_SIGNS = {(1, 1): "▲", (-1, -1): "▼", (1, -1): "↻", (-1, 1): "↺"}  # by how the wheels turn
# Screen colours for the letters of a colour field; other letters are shown in yellow.
_COLOURS = {"R": "red", "G": "green", "B": "blue"}


def picture(protocol: Protocol, state: State) -> list[Text]:
    """The rows of the picture, at most 26 columns wide."""
    rows = _car(protocol, protocol.wheels, state) if protocol.wheels else []
    for spec in protocol.variables.values():
        if spec.bits or not protocol.wheels:
            rows.append(_variable(spec, getattr(state, spec.name)))
    return rows[:ROWS]


def _car(protocol: Protocol, car: Wheels, state: State) -> list[Text]:
    full = max((abs(end) for end in protocol.limits.get(car.steering, (0, 0))), default=0)
    left, right = car.wheels(state, full)
    style = "bold" if state.moving else "dim"
    motion = getattr(state, car.by)
    directed = motion in car.turns
    axle = ["▲" if speed > 0 else "▼" if speed else "▪" for speed in (left, right)]
    stands = ", speed 0" if directed and not state.moving else ""
    return [
        Text("┌───────┐".join(axle).center(WIDTH)),
        Text.assemble(
            "        │   ", (_SIGNS[car.turns[motion]] if directed else "■", style), "   │"
        ),
        Text("└───────┘".join(axle).center(WIDTH)),
        Text(f"{motion.replace('_', ' ')}{stands}".center(WIDTH), style),
        Text(f"wheels {left:+d} {right:+d}".center(WIDTH), "dim"),
        _speed(protocol, car, getattr(state, car.speed)),
        _steering(full, getattr(state, car.steering)),
    ]


def _speed(protocol: Protocol, car: Wheels, speed: int) -> Text:
    filled = round(_BAR * speed / (max(protocol.limits.get(car.speed, (0, 0))) or 1))
    rest = "░" * (_BAR - filled)
    return Text.assemble(("speed ", "dim"), "█" * filled, (rest, "dim"), f" {speed}")


def _steering(full: int, steering: int) -> Text:
    half, track = _BAR // 2, ["─"] * (_BAR + 1)
    track[half] = "┼"
    track[half + round(half * steering / (full or 1))] = "●"
    return Text.assemble(("steer ", "dim"), "".join(track), f" {steering:+d}")


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


_LEAST = "  ? help  q quit"  # the keys beside what is told


def head_line(
    told: Told, feed: Feed, frames: FrameList, doing: str, expression: str, width: int
) -> Text:
    """What is shown, by which grammar, and recorded, and how many rows of how many, never cut.

    `doing` is how the chosen row moves by itself, `expression` the filter; both "" for none.
    """
    left = Text(f"/ {printable(expression)}  " if expression else "", "bold cyan", end="")
    protocol = feed.recording.protocol
    grammar = f" · {protocol.name} {protocol.version} · {told.line}"
    left = Text.assemble(left, (printable(told.title), "bold"), (grammar, "dim"))
    if feed.captured:
        left.append(f"  {RECORDS} {printable(feed.captured)}")
    shown, rows = frames.count - frames.view.first, feed.recording.rows - feed.recording.first
    share = feed.progress  # its thread may be done at any moment
    right = Text(f"  reading {share:.0%}" if share is not None else doing and f"  {doing}")
    if frames.held is not None:
        waiting = frames.view.count - frames.count
        right = Text.assemble("  ", (f"paused, {waiting:,} waiting", "bold reverse"))
    right.append(f"  {shown:,} of {rows:,}" if expression else f"  {quantity(rows, 'row')}", "bold")
    return _spread(left, right, width)


def status_line(doing: str, feed: Feed, said: str, width: int) -> Text:
    """What takes long just now, else what has to be told; else the keys.

    `doing` is what takes long, and `said` answers the last key; both are "" for nothing.
    """
    said = said or feed.notice
    if feed.let_go and not said:
        said = "no room for all rows: the oldest were dropped"
    if doing:
        told = Text(f"{doing}, Esc stops it", "bold")
    else:
        told = Text(printable(feed.said), "bold red") if feed.said else Text(said, "bold")
    if told:
        fits = width - told.cell_len >= len(_LEAST)
        return _spread(told, Text(_LEAST if fits else "", "dim"), width)
    line = Text()
    keys = [key for key in BINDINGS if key.show]
    room = width + 3 - sum(len(f"{key.key_display} {key.description}") + 3 for key in keys[-2:])
    for key in keys:
        shown = Text.assemble((key.key_display or "", "bold"), (f" {key.description}   ", "dim"))
        if line.cell_len + shown.cell_len <= room or key in keys[-2:]:
            line.append_text(shown)
    line.truncate(width, overflow="crop")
    return line


def _spread(left: Text, right: Text, width: int) -> Text:
    """Two texts at the ends of a line, of which the right one is never cut."""
    left.truncate(max(0, width - right.cell_len), overflow="ellipsis", pad=True)
    return left + right
