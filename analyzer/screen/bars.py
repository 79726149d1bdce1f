"""The line above the panes, and the line below them: what is shown, and how it stands."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from bilprov.analyzer.screen.feeds import Feed
from bilprov.analyzer.screen.frame_list import FrameList
from bilprov.analyzer.screen.keys import BINDINGS
from bilprov.analyzer.screen.signs import RECORDS
from bilprov.captures.text import printable, quantity

_LEAST = "  ? help  q quit"  # the keys beside what is told


def head_line(
    title: str, feed: Feed[Any], frames: FrameList, doing: str, expression: str, width: int
) -> Text:
    """What is shown and recorded, and how many rows of how many, which is never cut.

    `doing` is how the chosen row moves by itself, `expression` the filter; both "" for none.
    """
    left = Text(f"/ {printable(expression)}  " if expression else "", "bold cyan", end="")
    left = Text.assemble(left, (printable(title), "bold"))
    if feed.captured:
        left.append(f"  {RECORDS} {printable(feed.captured)}")
    shown, rows = frames.count - frames.view.first, feed.recording.rows - feed.recording.first
    share = feed.progress  # its thread may be done at any moment
    right = Text(f"  reading {share:.0%}" if share is not None else f"  {doing}")
    if frames.held is not None:
        waiting = frames.view.count - frames.count
        right = Text.assemble("  ", (f"paused, {waiting:,} waiting", "bold reverse"))
    right.append(f"  {shown:,} of {rows:,}" if expression else f"  {quantity(rows, 'row')}", "bold")
    return _spread(left, right, width)


def status_line(doing: str, feed: Feed[Any], said: str, width: int) -> Text:
    """What takes long just now, else what has to be told; else the keys.

    `doing` is what takes long, and `said` answers the last key; both are "" for nothing.
    """
    told = _told(doing, feed, said)
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


def _told(doing: str, feed: Feed[Any], said: str) -> Text:
    if doing:
        return Text(f"{doing}, Esc stops it", "bold")
    if feed.said:
        return Text(printable(feed.said), "bold red")
    said = said or feed.notice
    if feed.let_go and not said:
        recording = feed.recording
        (oldest,) = recording.records([recording.first]) or (None,)
        since = f"{oldest.t / 1e9:.3f} s" if oldest else "the first row"
        said = f"no room for all rows: the oldest were dropped, the rest begins at {since}"
    return Text(said, "bold")


def _spread(left: Text, right: Text, width: int) -> Text:
    """Two texts at the ends of a line, of which the right one is never cut."""
    left.truncate(max(0, width - right.cell_len), overflow="crop", pad=True)
    return left + right
