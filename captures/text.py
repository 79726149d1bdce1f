"""Makes foreign text safe to show: escapes control characters, bidi marks and invisible ones."""

from __future__ import annotations

import re
from typing import Any

# C0 and C1 controls, lone surrogates, marks that change the direction of text or are invisible,
# line and paragraph separators, and characters that are not allowed in XML.
_UNSEEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff"
    "\ufff9-\ufffb\ufffe\uffff]"
)


def escape_controls(text: str) -> str:
    """Replace each control character, bidi mark and lone surrogate by an escape like `\\x1b`."""
    return _UNSEEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def escape_all_controls(value: Any) -> Any:
    """Apply `escape_controls` to every string in a value made of dicts and lists."""
    if isinstance(value, str):
        return escape_controls(value)
    if isinstance(value, dict):
        return {
            escape_all_controls(key): escape_all_controls(inner) for key, inner in value.items()
        }
    return (
        [escape_all_controls(inner) for inner in value]
        if isinstance(value, list | tuple)
        else value
    )


def quantity(count: int, noun: str, plural: str = "") -> str:
    """A count with its noun: `1 answer`, `2 answers`; `plural` is for what takes no plain s."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def ordinal(number: int) -> str:
    """An ordinal number in digits: `1st`, `2nd`, `13th`."""
    last = "th" if 10 <= number % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"


PRINTABLE_CHARACTERS = 200


def printable(text: object) -> str:
    """Convert foreign text to one safe line: control, bidi and broken characters become escapes.

    At most 200 characters are kept; an ellipsis marks a cut.
    """
    line = str(text)
    clipped = line[:PRINTABLE_CHARACTERS]
    safe = "".join(
        character if character.isprintable() else f"\\x{ord(character):02x}"
        for character in clipped
    )
    if len(line) > PRINTABLE_CHARACTERS or len(safe) > PRINTABLE_CHARACTERS:
        return safe[: PRINTABLE_CHARACTERS - 1] + "…"
    return safe
