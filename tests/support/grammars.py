"""Other grammars of the family, made from the kit's own by edits of its text."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.spec import checks
from bilprov.spec.codec import judge, nearest
from bilprov.spec.errors import UserError
from bilprov.spec.explain import explain
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations
from tests.support import ROOT
from tests.vectors_checks import DIGITS, CheckVector

# Each edit: a piece of the grammar's text that stands there once, and what takes its place.
_WIDE = {
    "speed=Whole(0, 255)": "speed=Whole(0, 70_000)",
    "steering=Whole(-255, 255)": "steering=Whole(-300, 301)",
    'led=Bits("RGB")': "led=Whole(-400, 7)",
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
        effect=Sets(motion="backward", speed=From("pace"), led=From("lamp", factor=-2)),
    )
    * "Drives backward at a speed, with the lamp on.",
"""


def undeclared(text: str) -> str:
    """The grammar's text as it was before it declared the state: any numbers may be set."""
    return text[: text.index("DEVICE =")] + text[text.index("HEADER =") :]


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


def mutated(text: str, changes: dict[str, str]) -> str:
    """The text with every change made at once; each must have something to change."""
    for old, new in changes.items():
        assert old in text, f"the grammar does not say {old!r}"
        assert old != new
    pattern = "|".join(re.escape(old) for old in sorted(changes, key=len, reverse=True))
    return re.sub(pattern, lambda found: changes[found[0]], text)


def embedded(text: str) -> Protocol:
    """Load a grammar's text as that of a capture is loaded."""
    require_declarations(text)
    return load(text)


# Pieces that take the place of others in random grammars.
PIECES = (
    *("0", "-1", "1", "255", "256", "4294967296", "1.5", "1e999", "None", "True", "False", '""'),
    *('"a"', '"\\x1b[2J"', '"\\u202e"', '"[/x]"', "[]", "()", "{}", "[1]", "{1: 2}", "this"),
    *("this.a.b", "Byte", "HEADER", "INSTRUCTIONS", "Motion", "Motion.FORWARD", "Outcome.VALID"),
    *("BitsInteger(64)", "BitsInteger(0)", "BitsInteger(-1)", "Struct()", "Sets()", 'From("rgb")'),
    *("Sets(speed=-1)", 'Sets(led=From("speed", 0))', "Ranged(Byte, 0, 7)", "Answers(Byte, {})"),
    *('"a" / Byte', 'Byte * "a"', "Instruction(document='')", "Switch(this.x, {})", "BitStruct()"),
)
VALUE = re.compile(r"""[+-]?\b\d+\b|"[^"\n]*"|\b[A-Z][A-Za-z.]*\b(?:\([^()\n]*\))?""")


def loaded_or_said(text: str) -> Protocol | str:
    """The protocol of an embedded grammar, or what is said about it."""
    try:
        require_declarations(text)
        return load(text)
    except (NotDeclared, UserError) as error:
        return str(error)


def use(protocol: Protocol, headers: Iterable[int]) -> None:
    """Decode, judge, explain and apply frames with some data, and compute with what is declared."""
    assert protocol.timing.truncation_timeout + protocol.timing.answer_deadline > 0
    assert LineSettings(protocol.line.baud, protocol.line.parity, protocol.line.stopbits).byte_time
    for header in headers:
        for data in (b"", b"\0", b"\xff"):
            frame = (bytes([header]) + data * protocol.lengths[header])[:9]
            judgement = judge(protocol, frame)
            assert judgement.describe().isprintable()
            assert judgement.reason.isprintable()
            assert judge(protocol, nearest(protocol, frame)).valid
            assert explain(protocol, frame).frames
            if judgement.valid and judgement.instruction:
                effect = judgement.instruction.effect
                assert effect.apply(protocol.power_on, dict(judgement.fields)).moving in (0, 1)
    assert protocol.variables
    assert protocol.longest_frame > 0


# Every text that a grammar has, `~` where more can be put in.
PLACES = {
    "the name": {'NAME = "robot-car"': 'NAME = "car~"'},
    "the version": {'VERSION = "1.1"': 'VERSION = "1~"'},
    "the document": {'DOCUMENT = "': 'DOCUMENT = "~'},
    "a part of the header": {'"which instruction it is"': '"~which"'},
    "an instruction": {'1: "Speed"': '1: "Sp~eed"'},
    "an instruction's document": {'document="Hastighet"': 'document="~Hastighet"'},
    "an instruction's prose": {"Sets the speed with": "Sets ~ the speed with"},
    "a field": {'"speed" /': '"sp~eed" /', 'From("speed")': 'From("sp~eed")'},
    "a field's prose": {'"speed that the': '"~speed that the'},
    "the bits": {'bits="RGB"': 'bits="R~"'},
    "the reading": {'reading="R-led-upper-bits"': 'reading="R-~"'},
    "a response": {'"OK", Outcome': '"O~K", Outcome'},
    "a response's document": {'"Korrekt instruktion': '"~Korrekt instruktion'},
    "a response's prose": {'"correct instruction': '"~correct instruction'},
    "the header's clause": {'header="section 2"': 'header="~section 2"'},
    "the instructions' clause": {'instructions="section 3,': 'instructions="~section 3,'},
    "the responses' clause": {'responses="section 4,': 'responses="~section 4,'},
    "the safety's clause": {'safety="section 2"': 'safety="~section 2"'},
}


_NAMES = {*PLACES["an instruction"], *PLACES["a field"]}


def with_texts(grammar_text: str, piece: str, places: dict[str, str]) -> str:
    """The grammar's text with a piece put into its texts at these places.

    In a name, which is one word, its spaces are left out.
    """
    word = "".join(piece.split())
    return mutated(
        grammar_text,
        {old: new.replace("~", word if old in _NAMES else piece) for old, new in places.items()},
    )


RELAY = (ROOT / "tests" / "support" / "switch_grammar.py").read_text(encoding="utf-8")
"""A grammar of its own, framed as the car's is: a frame of the car means something else."""
TIMES = RELAY[RELAY.index("TIMING = ") :]
"""What ends a grammar that says nothing of its line and its times."""

CAMERA = (
    '''\
"""Sony's VISCA: two inquiries of a camera. Who is meant, and who answers, is three bits."""

from construct import BitsInteger, BitStruct, Byte, Bytes, Const, Int24ub, Struct, Switch, this

from bilprov.spec.fields import (
    Address, Clauses, Data, Instruction, LineDefaults, Outcome, Same, Timing,
)

NAME = "visca"
VERSION = "1"
DOCUMENT = "VISCA command list"
INSTRUCTIONS = {
    0x090400: "Power" / Instruction(document="CAM_PowerInq", answer=Struct("power" / Byte)),
    0x090447: "Zoom"
    / Instruction(document="CAM_ZoomPosInq", answer=Struct("position" / Bytes(4))),
}
ONE = Const(1, BitsInteger(1))
ZERO = Const(0, BitsInteger(1))
FRAME = Struct(
    "head" / BitStruct(
        "mark" / ONE,
        "sender" / BitsInteger(3),
        ZERO,
        "address" / Address(BitsInteger(3), 1, 7),
    ),
    "id" / Int24ub,
    "data" / Switch(this.id, INSTRUCTIONS),
    "end" / Const(b"\\xff"),
)
REPLY = Struct(
    "head" / BitStruct(
        ONE, "address" / Same("address", BitsInteger(3)), ZERO, "receiver" / BitsInteger(3)
    ),
    Const(b"\\x50"),
    "data" / Data(),
    "end" / Const(b"\\xff"),
)
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_SYNC)
'''
    + TIMES
)


SWITCHES = (
    """\
from construct import *
from bilprov.spec.fields import *

NAME, VERSION, DOCUMENT = "switches", "1", "none"
MODE = Enum(Int16ul, off=0, on=1, slow=300)
INSTRUCTIONS = {
    1: "Set"
    / Instruction(
        "modes" / Array(2, MODE),
        "limits" / PrefixedArray(Byte, Ranged(Int8sb, -3, 5)),
        document="",
        answer=Struct("alarms" / Array(2, FlagsEnum(Byte, hot=1, slow=2))),
    )
}
FRAME = Struct("id" / Byte, "data" / Switch(this.id, INSTRUCTIONS), "end" / Const(b"\\xee"))
REPLY = Struct("id" / Same("id", Byte), "data" / Data(), "end" / Const(b"\\xee"))
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_DATA, Outcome.BAD_SYNC)
"""
    + TIMES
)
"""Several numbers in a row, each of which has names, flags or a range."""


def checked_digits(vector: CheckVector, order: Literal["big", "little"]) -> tuple[Protocol, bytes]:
    """A grammar of one request with nine bytes and their check, and that of the published value."""
    size = -(-eval(vector.declared, vars(checks)).bits // 8)
    kind = "Byte" if size == 1 else f"Int{8 * size}u{order[0]}"
    text = f"""\
from construct import *
from bilprov.spec.fields import *

NAME, VERSION, DOCUMENT = "{vector.name}", "1", "none"
INSTRUCTIONS = {{1: "Put" / Instruction("digits" / Bytes(9), document="", answer=None)}}
FRAME = Struct(
    "id" / Byte,
    "covered" / RawCopy(Struct("data" / Switch(this._.id, INSTRUCTIONS))),
    "check" / Checksum({kind}, {vector.declared}, this.covered.data),
)
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM)
"""
    return load(text + TIMES), b"\1" + DIGITS + vector.value.to_bytes(size, order)
