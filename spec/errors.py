"""Errors whose text is one sentence for the user, and the checks of what a grammar declares.

Whatever a grammar says may reach a terminal, a file name or a header of C. So its texts are short
and hold only characters that print: nothing that shows them has to make them safe.
"""

from __future__ import annotations

import reprlib
from typing import Any

LONGEST_SENTENCE = 4000


def one_line(text: object, most: int = LONGEST_SENTENCE) -> str:
    """Foreign text as one line of at most `most` characters, all of which print.

    What does not print becomes an escape like `\\x1b`. Of a longer text the middle is left out: in
    a sentence what came stands first, what to do last.
    """
    line = str(text)
    if len(line) > 4 * most:
        line = line[: 2 * most] + line[-2 * most :]
    line = " ".join(line.split())
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    half = most // 2
    return line if len(line) <= most else f"{line[:half]} … {line[half + 3 - most :]}"


class UserError(Exception):
    """Wrong input, or something unusable; the text says what came, what is allowed, what to do.

    Whatever foreign text is in it, it is one line that a terminal can show.
    """

    def __init__(self, sentence: object = "") -> None:
        super().__init__(one_line(sentence))


LONGEST_NAME = 64
LONGEST_TEXT = 1000
LARGEST = 1 << 128
"""The bound of the numbers that an effect may set or multiply with."""


class WrongValue(UserError):
    """Raised for a declared value of a wrong type or size; the text says what is allowed."""


def shown(value: object) -> str:
    """A value in a few characters, all of which print."""
    return one_line(reprlib.repr(value), LONGEST_NAME)


def require_text(what: str, value: Any, most: int = LONGEST_TEXT) -> None:
    """Raise WrongValue unless the value is a text of at most `most` characters that all print."""
    if not isinstance(value, str):
        raise WrongValue(f"{what} is {shown(value)}, allowed is a text")
    if len(value) > most:
        raise WrongValue(f"{what} has {len(value)} characters, allowed are {most}")
    unseen = next((character for character in value if not character.isprintable()), "")
    if unseen:
        raise WrongValue(
            f"{what} holds the character U+{ord(unseen):04X}, allowed are characters that print"
        )


def require_name(what: str, value: Any) -> None:
    """Raise WrongValue unless the value is a short text that does not consist of spaces only."""
    require_text(what, value, LONGEST_NAME)
    if not value.strip():
        raise WrongValue(f"{what} is empty, allowed is a name")


def require_word(what: str, value: Any) -> None:
    """Raise WrongValue unless the value is a name without spaces, which can be typed as one."""
    require_name(what, value)
    if len(value.split()) > 1:
        raise WrongValue(f"{what} is {shown(value)}, allowed is one word")


def require_whole(what: str, value: Any, low: int = -LARGEST, high: int = LARGEST) -> None:
    """Raise WrongValue unless the value is a whole number in low..high."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise WrongValue(f"{what} is {shown(value)}, allowed is a whole number")
    if not low <= value <= high:
        reach = "2 to the 128th at most" if high == LARGEST else f"{low} to {high}"
        raise WrongValue(f"{what} is {value}, allowed is {reach}")


def require_number(what: str, value: Any, above: float, most: float) -> None:
    """Raise WrongValue unless the value is a number greater than `above`, and `most` at most."""
    if not isinstance(value, int | float) or isinstance(value, bool) or value != value:
        raise WrongValue(f"{what} is {shown(value)}, allowed is a number")
    if not above < value <= most:
        raise WrongValue(f"{what} is {value}, allowed is more than {above:g} and at most {most:g}")


def require_kind(what: str, value: Any, kind: type) -> None:
    """Raise WrongValue unless the value is of that kind."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise WrongValue(f"{what} is {shown(value)}, allowed is {article} {kind.__name__}")
