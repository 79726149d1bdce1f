"""Makes foreign text safe to show: escapes control characters, bidi marks and invisible ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable


class _Escapes(dict[int, str]):
    """What stands for each character in `str.translate`, found out when it is first met."""

    def __init__(self, escape: Callable[[str], str]) -> None:
        self._escape = escape

    def __missing__(self, number: int) -> str:
        character = chr(number)
        shown = character if character.isprintable() else self._escape(character)
        if len(self) < _REMEMBERED:
            self[number] = shown
        return shown


def _in_json(character: str) -> str:
    import json  # which takes long, and every command needs this module

    return json.dumps(character)[1:-1]


_REMEMBERED = 1 << 16  # characters
_PLAIN = _Escapes(lambda character: character.encode("unicode_escape").decode())
_IN_JSON = _Escapes(_in_json)
_IN_JSON[ord("\n")] = "\n"


def escape_controls(text: str) -> str:
    """Replace each character that does not print by an escape like `\\x1b`; gives one line.

    These are control characters, marks that change the direction of text, characters of no width,
    lone surrogates, all spaces but the usual one, and all that XML does not allow.
    """
    return text if text.isprintable() else text.translate(_PLAIN)


def escape_json(data: bytes) -> bytes:
    """JSON of the same value in which every character prints, but for its line ends."""
    if data.isascii() and b"\x7f" not in data:  # JSON itself escapes the rest
        return data
    return data.decode().translate(_IN_JSON).encode()


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
