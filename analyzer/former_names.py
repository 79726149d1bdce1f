"""What commands are called now that once had another name."""

from __future__ import annotations

FORMER = {
    "browse": "replay",
    "info": "capture info",
    "cut": "capture cut",
    "join": "capture join",
    "recover": "capture repair",
    "convert": "capture decode",
    "compare": "capture diff",
    "doctor": "ports, and for a capture bilprov capture check",
    "shell": "send",
    "emulate": "simulate --firmware",
    "score": "lab score",
    "learn": "lab learn",
    "line": "lab line",
}
"""What commands are called now, by their former names."""


def former_name(name: str) -> str:
    """A sentence with what a command is called now; "" if it is no former name."""
    return f"bilprov {name} is now bilprov {FORMER[name]}" if name in FORMER else ""
