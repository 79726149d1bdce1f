"""Other grammars of the family, made from the kit's own by edits of its text."""

from __future__ import annotations

# Each edit: a piece of the grammar's text that stands there once, and what takes its place.
_WIDE = {
    "BitStruct, Byte,": "BitStruct, Byte, BytesInteger, Int8sb, Int16sl, Int16ub,",
    '"id" / BitsInteger(4)': '"id" / BitsInteger(3)',
    '"length" / BitsInteger(4)': '"length" / BitsInteger(5)',
    '"speed" / Ranged(Byte, 0, 255)': '"speed" / Ranged(Int16ub, 0, 60_000)',
    '"strength" / Ranged(Byte, 0, 255) * "steering strength",\n        document="Höger"': (
        '"strength" / Ranged(Int16sl, -300, 301) * "steering strength",\n        document="Höger"'
    ),
    '"strength" / Ranged(Byte, 0, 255) * "steering strength",\n        document="Vänster"': (
        '"strength" / Ranged(Int8sb, -5, 120) * "steering strength",\n        document="Vänster"'
    ),
}

# In place of the last three instructions: two fields, one of three bytes. ID 7 stays unused.
_CRUISE = """\
    6: "Cruise"
    / Instruction(
        "pace" / Ranged(BytesInteger(3), 256, 70_000) * "speed",
        "lamp" / Ranged(Byte, 1, 200) * "colours",
        document="Marschfart",
        effect=Sets(motion=Motion.BACKWARD, speed=From("pace"), led=From("lamp", factor=-2)),
    )
    * "Drives backward at a speed, with the lamp on.",
"""


def short_grammar(text: str) -> str:
    """The grammar's text with headers of 7 bits for the ID and one for the length."""
    return text.replace('"id" / BitsInteger(4)', '"id" / BitsInteger(7)').replace(
        '"length" / BitsInteger(4)', '"length" / BitsInteger(1)'
    )


def still_grammar(text: str) -> str:
    """The grammar's text with Stop and Speed alone: nothing moves it, nothing steers it."""
    return text[: text.index('    2: "Forward"')] + text[text.index("}\n\nFRAME =") :]


def wide_grammar(text: str) -> str:
    """The grammar's text with fields of one to three bytes, signed ones among them.

    Its headers have 3 bits for the ID and 5 for the length, and one instruction has two fields.
    """
    for old, new in _WIDE.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    before, middle = text.split('    6: "RotateRight"')
    return before + _CRUISE + middle[middle.index("}\n\nFRAME =") :]
