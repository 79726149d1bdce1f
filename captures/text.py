"""Makes foreign text safe to show: escapes control characters, bidi marks and invisible ones."""

from __future__ import annotations

import re
from collections.abc import Iterable

_UNUSUAL = re.compile("[^ -~]")  # what may not print


def escape_controls(text: str) -> str:
    """Replace each character that does not print by an escape like `\\x1b`; gives one line.

    These are control characters, marks that change the direction of text, characters of no width,
    lone surrogates, all spaces but the usual one, and all that XML does not allow.
    """

    def shown(found: re.Match[str]) -> str:
        character = found[0]
        return character if character.isprintable() else character.encode("unicode_escape").decode()

    return text if text.isprintable() else _UNUSUAL.sub(shown, text)


def escape_json(data: bytes) -> bytes:
    """JSON of the same value in which every character prints, but for its line ends."""
    if data.isascii() and b"\x7f" not in data:  # JSON itself escapes the rest
        return data
    import json  # which takes long, and every command needs this module

    def shown(found: re.Match[str]) -> str:
        character = found[0]
        prints = character.isprintable() or character == "\n"
        return character if prints else json.dumps(character)[1:-1]

    return _UNUSUAL.sub(shown, data.decode()).encode()


def quantity(count: int, noun: str, plural: str = "") -> str:
    """A count with its noun: `1 answer`, `2 answers`; `plural` is for what takes no plain s."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def near(word: str, names: Iterable[str], alike: float = 0.6) -> str:
    """The name that is meant by a word with a slip in it, in any case; "" if there is none.

    `alike` is how alike they must be, of 1.
    """
    from difflib import get_close_matches

    by_folded = {name.casefold(): name for name in reversed([*names])}
    close = get_close_matches(word.casefold(), by_folded, 1, alike)
    return by_folded[close[0]] if close else ""


PRINTABLE_CHARACTERS = 200


def printable(text: object) -> str:
    """Convert foreign text to one safe line: control, bidi and broken characters become escapes.

    At most 200 characters are kept; an ellipsis marks a cut.
    """
    line = str(text)
    safe = escape_controls(line[:PRINTABLE_CHARACTERS])
    if len(line) > PRINTABLE_CHARACTERS or len(safe) > PRINTABLE_CHARACTERS:
        return safe[: PRINTABLE_CHARACTERS - 1] + "…"
    return safe
