"""The base class of errors whose text is one sentence for the user."""

from __future__ import annotations

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
