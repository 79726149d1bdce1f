"""The signs that the screen is drawn with, also for terminals that have no others than ASCII."""

from __future__ import annotations

from typing import NamedTuple


class Signs(NamedTuple):
    """One set of signs; `motions` has one for each Motion, in their order."""

    to_device: str = "→"
    to_host: str = "←"
    mark: str = "◆"
    cut: str = "…"
    folded: str = "▸"
    unfolded: str = "▾"
    bar: str = "█"
    bar_rest: str = "░"
    track: str = "─"
    track_middle: str = "┼"
    knob: str = "●"
    lit: str = "●"
    unlit: str = "○"
    wheel_forward: str = "▲"
    wheel_backward: str = "▼"
    wheel_still: str = "▪"
    body: tuple[str, str, str] = ("┌───────┐", "│", "└───────┘")
    scroll: str = "█"
    motions: str = "■▲▼↻↺"


FINE = Signs()
PLAIN = Signs(
    to_device=">",
    to_host="<",
    mark="*",
    cut="~",
    folded="+",
    unfolded="-",
    bar="#",
    bar_rest=".",
    track="-",
    track_middle="+",
    knob="o",
    lit="*",
    unlit="o",
    wheel_forward="^",
    wheel_backward="v",
    wheel_still=".",
    body=("+-------+", "|", "+-------+"),
    scroll="#",
    motions="x^v)(",
)


def signs_for(encoding: str | None) -> Signs:
    """The fine signs, where an encoding has them all; else the plain ones."""
    try:
        f"{FINE}─━".encode(encoding or "ascii")  # its representation has all of its signs
    except (UnicodeEncodeError, LookupError):
        return PLAIN
    return FINE
