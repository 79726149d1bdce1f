"""The signs that the screen is drawn with, also for terminals that have no others than ASCII."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bilprov.spec.motion import Motion


@dataclass(frozen=True, slots=True)
class Signs:
    """One set of signs."""

    to_device: str
    to_host: str
    mark: str
    cut: str
    folded: str
    unfolded: str
    bar: str
    bar_rest: str
    track: str
    track_middle: str
    knob: str
    lit: str
    unlit: str
    wheel_forward: str
    wheel_backward: str
    wheel_still: str
    body: tuple[str, str, str]
    scroll: str
    motions: Mapping[Motion, str]


FINE = Signs(
    to_device="→",
    to_host="←",
    mark="◆",
    cut="…",
    folded="▸",
    unfolded="▾",
    bar="█",
    bar_rest="░",
    track="─",
    track_middle="┼",
    knob="●",
    lit="●",
    unlit="○",
    wheel_forward="▲",
    wheel_backward="▼",
    wheel_still="▪",
    body=("┌───────┐", "│", "└───────┘"),
    scroll="█",
    motions={
        Motion.STOPPED: "■",
        Motion.FORWARD: "▲",
        Motion.BACKWARD: "▼",
        Motion.ROTATE_RIGHT: "↻",
        Motion.ROTATE_LEFT: "↺",
    },
)
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
    motions={
        Motion.STOPPED: "x",
        Motion.FORWARD: "^",
        Motion.BACKWARD: "v",
        Motion.ROTATE_RIGHT: ")",
        Motion.ROTATE_LEFT: "(",
    },
)


def signs_for(encoding: str | None) -> Signs:
    """The fine signs, where an encoding has them all; else the plain ones."""
    try:
        f"{FINE}─━".encode(encoding or "ascii")  # its representation has all of its signs
    except (UnicodeEncodeError, LookupError):
        return PLAIN
    return FINE
