"""What goes wrong with a capture, in one sentence: what came, what was allowed, what to do."""

from __future__ import annotations

SHOWN_CHARACTERS = 200


class CaptureError(Exception):
    """A capture file cannot be written or read. The message is one sentence for the user."""


def shown(text: object) -> str:
    """Foreign text as one harmless line: control, bidi and broken characters become escapes.

    At most 200 characters are kept; what was cut is marked with an ellipsis.
    """
    line = str(text)
    clipped = line[:SHOWN_CHARACTERS]
    safe = "".join(
        character if character.isprintable() else f"\\x{ord(character):02x}"
        for character in clipped
    )
    if len(line) > SHOWN_CHARACTERS or len(safe) > SHOWN_CHARACTERS:
        return safe[: SHOWN_CHARACTERS - 1] + "…"
    return safe
