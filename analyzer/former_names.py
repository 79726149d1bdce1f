"""What commands are called now that once had another name."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

FORMER = {
    "browse": ("replay",),
    "info": ("capture", "info"),
    "cut": ("capture", "cut"),
    "join": ("capture", "join"),
    "recover": ("capture", "repair"),
    "convert": ("capture", "decode"),
    "compare": ("capture", "diff"),
    "doctor": ("ports",),
    "shell": ("send",),
    "emulate": ("simulate", "--firmware"),
    "score": ("lab", "score"),
    "learn": ("lab", "learn"),
    "line": ("lab", "line"),
}
"""What commands are called now, by their former names."""


def former_name(name: str, arguments: Sequence[str] = ()) -> str:
    """A sentence with what a command is called now, and its arguments; "" if it is no former name.

    >>> former_name("cut", ["a.mcap", "b.mcap"])
    'bilprov cut is now bilprov capture cut: bilprov capture cut a.mcap b.mcap'
    """
    new = FORMER.get(name)
    if new is None:
        return ""
    if name == "doctor" and any(word.endswith(".mcap") for word in arguments):
        new = ("capture", "check")
    words = [*new, *(word for word in arguments if word != "--decoded")]
    example = f": bilprov {shlex.join(words)}" if arguments else ""
    return f"bilprov {name} is now bilprov {' '.join(new)}{example}"
