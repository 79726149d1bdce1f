"""The line above the panes, and the line below them: what is shown, and how it stands."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from bilprov.analyzer.screen.feeds import Feed
from bilprov.analyzer.screen.frame_list import FrameList
from bilprov.captures.text import printable


def head_line(title: str, feed: Feed[Any], frames: FrameList, doing: str, width: int) -> Text:
    """What is shown and recorded, and the place in it, which is never cut.

    `doing` is how the chosen row moves by itself, "" if it does not.
    """
    place = _place(feed, frames, doing)
    left = Text.assemble(("bilprov ", "bold"), printable(title))
    if feed.captured:
        left.append(f"  {frames.signs.lit} {printable(feed.captured)}")
    left.truncate(max(0, width - place.cell_len), overflow="crop")
    return _spread(left, place, width)


def status_line(doing: str, feed: Feed[Any], said: str, expression: str, width: int) -> Text:
    """What takes long just now, else what has to be told; the filter; the keys to begin with.

    `doing` is what takes long, and `said` answers the last key; both are "" for nothing.
    """
    status = _status(doing, feed, said, expression)
    return _spread(status, Text("? help  q quit", "dim"), width)


def _place(feed: Feed[Any], frames: FrameList, moving: str) -> Text:
    if frames.held is not None:
        waiting = frames.view.count - frames.count
        return Text(f"  paused, {waiting:,} waiting", "bold reverse")
    share = feed.progress  # its thread may be done at any moment
    doing = f"reading {share:.0%}  " if share is not None else ""
    doing += f"{moving}  " if moving else ""
    at = min(frames.cursor - frames.start + 1, frames.count - frames.start)
    place = f"  {doing}{at:,} of {frames.count - frames.start:,}"
    hidden = feed.recording.rows - frames.count
    return Text(f"{place} filtered from {feed.recording.rows:,}" if hidden > 0 else place)


def _status(doing: str, feed: Feed[Any], said: str, expression: str) -> Text:
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
    status = Text(f"filter: {printable(expression)}" if expression else "")
    if said and status:
        status.append("  ")
    return status.append(said, "bold")


def _spread(left: Text, right: Text, width: int) -> Text:
    """Two texts at the ends of a line; where both do not fit, the left one has all of it."""
    if left.cell_len + right.cell_len > width:
        right = Text()
    room = width - right.cell_len
    left = left.copy()
    left.truncate(room, overflow="crop", pad=True)
    line = left + right
    line.no_wrap = True
    line.truncate(width, overflow="crop")
    return line
