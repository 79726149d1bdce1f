"""The door of grammars: each wrong or hostile one ends in a short sentence, in bounded work.

A grammar inside a capture must first hold nothing but declarations; one that the user names is
loaded without that. What random values in a grammar do is a property in `tests/test_doors.py`.
"""

from __future__ import annotations

import json
import re

import pytest

from bilprov.spec.protocol import GrammarError, load
from bilprov.spec.safe_grammar import LONGEST, NotDeclared, require_declarations
from tests.support.commands import process
from tests.support.grammars import embedded, mutated

SPEED = '"speed" / Ranged(Byte, 0, 255)'
LED = "Ranged(Byte, 0, 7,"
ENUM = {"import BitsInteger,": "import BitsInteger, Enum,"}
RIGHT = 'steering=From("strength")),'
FAULTY = 'FAULTY = Sets(motion="stopped", steering=0)'
ID, LENGTH = '"id" / BitsInteger(4)', '"length" / BitsInteger(4)'
SIXTEEN = ", ".join(f'"f{n}" / Ranged(Byte, 0, 255)' for n in range(16))
HUNDRED_TWENTY_SEVEN = ", ".join(f'"f{n}" / Ranged(Byte, 0, 255)' for n in range(127))


def field(declaration: str) -> dict[str, str]:
    """What changes the field of Speed."""
    return {SPEED: declaration}


# What is replaced by what, and a piece of the sentence: one row for each rule.
WRONG: list[tuple[dict[str, str], str]] = [
    (
        {"2: Answer(": '5: Answer("TWO", Outcome.BAD_DATA, "", ""), 2: Answer('},
        "two responses stand for bad data",
    ),
    ({"\nFAULTY = Sets(": "\n_ = Sets("}, "it declares no FAULTY"),
    ({"\nPOWER_ON = Sets(": "\n_ = Sets("}, "it declares no POWER_ON"),
    (
        {"truncation_timeout=50": 'truncation_timeout="a"'},
        "Timing.truncation_timeout is 'a', allowed is a number",
    ),
    ({"truncation_shortest=5": "truncation_shortest=0"}, "allowed is a number > 0.001"),
    (
        {"answer_deadline=100": "answer_deadline=1e999"},
        "2 to the 32nd|is inf, allowed is a number <= 3600000",
    ),
    ({"    stop_longest=100,\n": ""}, "Missing required argument"),
    ({"TIMING = Timing(": "TIMES = Timing("}, "nothing uses 'TIMES'; did you mean TIMING?"),
    (
        {"POWER_ON = Sets(motion": "POWER_ON = [1]\nX = Sets(motion"},
        "POWER_ON is [1], allowed is a Sets",
    ),
    ({"baud=115200": "baud=0"}, "LineDefaults.baud is 0, allowed"),
    ({'parity="N"': 'parity="X"'}, "allowed is N, E, O, M, S"),
    ({'safety="section 2"': "safety=2"}, "Clauses.safety is 2"),
    ({'NAME = "robot-car"': 'NAME = "\\x1b]0;x\\x07"'}, "NAME holds"),
    ({'VERSION = "1.1"': "VERSION = 1.1"}, "VERSION is 1.1, allowed is a text"),
    ({'"OK", Outcome.VALID': '"", Outcome.VALID'}, "Answer.name is '', allowed is a text of"),
    # fields
    (field('"speed" / Enum(Byte)') | ENUM, "Speed.speed names no values"),
    (
        field('"speed" / Enum(Byte, slow=1.5)') | ENUM,
        "the value of slow of Speed.speed is 1.5, allowed is a whole number",
    ),
    (field('"speed" / Ranged(Byte, 0, 2.5)'), "is 2.5, allowed"),
    (field('"speed" / Ranged(Byte, 0, 256)'), "has the range 0 to 256, allowed is one from low"),
    (field('"speed" / Ranged(5, 0, 255)'), "Ranged.subcon is 5, allowed is a Construct (line"),
    (field('"speed" / Ranged(Struct(), 0, 1)'), "the type of Speed.speed must be a whole number"),
    (field('"speed" / Ranged(Switch(this.x, {1: Byte}, default=Byte), 0, 1)'), "cannot be used"),
    (field('"speed" / Ranged(BitsInteger(4), 0, 1)'), "must be a whole number"),
    (field("Ranged(Byte, 0, 255)"), "a field of Speed has no name; write it"),
    (field(f'"{"a" * 65}" / Ranged(Byte, 0, 255)'), "allowed are 64"),
    (field(f"{SPEED}, {SPEED}"), "Speed has two fields named speed"),
    (field(f"{SPEED}, {SIXTEEN}"), "Speed has 17 data bytes; a header announces at most 15"),
    ({'"speed that the': f'"{"x" * 1001}'}, "allowed are 1000"),
    ({LED: "Ranged(Byte, 7, 0,"}, "LED.rgb has the range 7 to 0, allowed"),
    ({'bits="RGB"': 'bits="RGBRGBRGB"'}, "names 9 bits, it has 8"),
    ({'reading="R-led-upper-bits"': "reading=[]"}, "Ranged.reading is [], allowed is a text"),
    # instructions
    (
        {'8: "LED"': '10: "Lamp" / Byte, 8: "LED"'},
        'instruction 10 of INSTRUCTIONS must be written "Name" /',
    ),
    ({'1: "Speed"': '1: "  "'}, "is empty"),
    ({'5: "Left"': '5: "RIGHT"'}, "two instructions are named Right"),
    ({'5: "Left"': '4: "Left"'}, "the number 4 stands twice in line"),
    ({'2: "Forward"': '1.0: "Forward"'}, "stands twice"),  # the same key in Python
    ({'8: "LED"': '16: "LED"'}, "the header cannot carry the ID 16"),
    ({'1: "Speed"': '[]: "Speed"'}, "unhashable"),
    ({'document="Stopp"': "document=5"}, "Instruction.document is 5"),
    # effects
    ({f"effect=Sets({RIGHT}": "effect=0,"}, "Instruction.effect is 0, allowed is a Sets"),
    (
        {RIGHT: 'steering="left"),'},
        "Right.effect sets steering to 'left', allowed is -255 to 255",
    ),
    ({RIGHT: 'steering=From("force")),'}, "Right.effect names the field force, which is not there"),
    ({RIGHT: "steering=From(7)),"}, "From.field is 7"),
    ({RIGHT: 'motion=From("strength")),'}, "sets motion to a number"),
    ({RIGHT: "motion=[]),"}, "Right.effect sets motion to []"),
    ({RIGHT: "steer=0),"}, "Right.effect sets steer, allowed are motion, speed, steering, led"),
    ({"factor=-1": "factor=0.5"}, "From.factor is 0.5"),
    ({'motion="stopped", steering=0),  #': "steering=0),  #"}, "the kit needs one to home"),
    ({FAULTY: "FAULTY = Sets(steering=0)"}, "FAULTY does not set motion"),
    ({FAULTY: 'FAULTY = Sets(speed=From("x"))'}, "names the field x, which is not there"),
    ({'POWER_ON = Sets(motion="stopped"': 'POWER_ON = Sets(motion="forward"'}, "still"),
    # answers
    ({'"TOO_MANY_DATA"': '"too_few_data"'}, "two responses are named"),
    (
        {'"OK", Outcome.VALID': '"OK", "fine"'},
        "Answer.outcome is 'fine'",
    ),
    ({"Outcome.TOO_FEW": "Outcome.TOO_MANY"}, "no response stands for too few data bytes"),
    ({"        0: Answer(": "        256: Answer("}, "allowed within it is a whole number <= 255"),
    ({"        0: Answer(": "        9: 5, 0: Answer("}, "Answers.answers is {0: Answer(name="),
    ({"Answers(\n    Byte": "Answers(\n    Struct()"}, "type of RESPONSE.code must be a whole"),
    # header and frame
    ({"HEADER = BitStruct(": "HEADER = BitStruct(HEADER, "}, "is HEADER in line|'HEADER'"),
    ({"HEADER = BitStruct(": "HEADER = Byte\nX = BitStruct("}, "FRAME has no part"),
    ({ID: '"kind" / BitsInteger(4)'}, "FRAME has no part"),
    ({ID: '"id" / BitsInteger(5)'}, "bits of FRAME are 9 together; they must fill"),
    ({ID: '"id" / BitsInteger(this.length)'}, "cannot be used"),
    (
        {ID: '"id" / BitsInteger(0)', LENGTH: '"length" / BitsInteger(8)'},
        "is 0, allowed is a whole number >= 1",
    ),
    ({"INSTRUCTIONS))": 'INSTRUCTIONS), "x" / Struct("id" / Byte))'}, "two parts for the id"),
    ({"INSTRUCTIONS))": "INSTRUCTIONS), BitsInteger(8))"}, "a part of FRAME has no name; write it"),
    ({"FRAME = Struct(": "FRAMES = Struct("}, "nothing uses 'FRAMES'; did you mean FRAME?"),
]

# What only a grammar that runs can hold.
RUN: list[tuple[dict[str, str], str]] = [
    ({"stop_longest=100": 'stop_longest=float("nan")'}, "is nan, allowed is a number"),
    ({"factor=-1": "factor=10**5000"}, "ValueError: a number has too many digits"),
    ({'1: "Speed"': '10**5000: "Speed"'}, "cannot be used: a number has too many digits"),
    ({'NAME = "': 'raise ValueError("\\x1b[2J" * 9999)\nNAME = "'}, "x1b"),
    ({'NAME = "': 'raise SystemExit(0)\nNAME = "'}, "SystemExit"),
    ({'NAME = "': '(f := lambda: f())()\nNAME = "'}, "RecursionError"),
    (
        field('"speed" / Ranged(__import__("construct").BitsInteger(8), 0, 1)'),
        "must be a whole number",
    ),
    ({'"steering strength"': 'b"x"'}, "is b'x', allowed is a text"),
    ({"spec.fields import": "spec.field import"}, "No module named 'bilprov.spec.field'"),
]


def sentence(text: str, *, declared: bool) -> str:
    """What is said about a grammar that cannot be used: one line, short, and all of it prints."""
    with pytest.raises((NotDeclared, GrammarError)) as raised:
        (embedded if declared else load)(text)
    said = str(raised.value)
    assert said.isprintable()
    assert len(said) < 400
    return said


@pytest.mark.parametrize(("changes", "piece"), WRONG, ids=[row[1] for row in WRONG])
def test_a_wrong_declaration_is_one_sentence_whoever_wrote_it(
    grammar_text: str, changes: dict[str, str], piece: str
) -> None:
    for declared in (True, False):
        said = sentence(mutated(grammar_text, changes), declared=declared)
        assert any(part in said for part in piece.split("|"))


@pytest.mark.parametrize(("changes", "piece"), RUN, ids=[row[1] for row in RUN])
def test_a_grammar_that_runs_ends_in_a_sentence_too(
    grammar_text: str, changes: dict[str, str], piece: str
) -> None:
    assert piece in sentence(mutated(grammar_text, changes), declared=False)


def test_pythons_own_remarks_about_a_grammar_are_not_shown(
    grammar_text: str, recwarn: pytest.WarningsRecorder
) -> None:
    assert "there is 1('\\d') in line" in sentence(f"{grammar_text}\nX = 1('\\d')\n", declared=True)
    load(f'{grammar_text}\nX = "\\d"\n')
    assert not recwarn.list


# Declarations only: a stranger's grammar can reach nothing else.

WORDS = (
    "from construct import BitsInteger, BitStruct, Byte, Struct, Switch, this\n"
    "from spec.fields import Answer, Answers, Instruction, Outcome, Ranged, Sets\n"
)
REFUSED = [
    *("import os", "from os import system", "from construct import Computed"),
    *("from construct import Byte as Int", "from .fields import Sets"),
    *("from bilprov.spec.fields import *", "X = eval('1')", "X = Sets()()", "X = Byte.parse(b'')"),
    *("X = this.__class__", "X = this._root", "X = 'a'.join", "X = Sets.values"),
    *("X = Outcome.VALID.value", "X = [a for a in 'b']", "def f(): pass", "class A: pass"),
    *("X = lambda: 1", "X = f'{1}'", "X = {}[0]", "Sets()", "X = Sets(**{'a': 1})", "X = {**{}}"),
    *("X = Sets(*[1])", "X = Sets(*this)", "X = Struct(*Byte)", "W = (99,)\nX = BitsInteger(*W)"),
    *(
        "W = ((99,),)\nX = BitsInteger(*W)",
        "X = this._._root",
        "X = 1 << 62",
        "X = 9 ** 9",
        "X = 'a' * 9999",
        "N = 9999\nX = N * 'a'",
    ),
    *("X = (9999 * 'a') * 'b'", "X = 99999999999", "X = this(1)", "X = BitsInteger(65)"),
    *("N = 99999\nM = N\nX = BitsInteger(M)", "X = b'1' * 9", "Byte = 1", "__builtins__ = 1"),
    *("X = 1\nX = 2", "X = Y", "X = Y = 1", "if 1: pass", "X = (", "X = '\0'"),
    f"X = {'[' * 50}{']' * 50}",  # deep enough to be refused, not too deep for Python
    *(f"X = {'(' * 5000}{')' * 5000}", f"X = {'-' * 5000}1", "#" * (LONGEST + 1)),
]


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:30])
def test_what_is_no_declaration_is_refused(text: str) -> None:
    with pytest.raises(NotDeclared):
        require_declarations(WORDS + text)


def test_the_refusal_says_what_and_where() -> None:
    with pytest.raises(NotDeclared, match="there is import os in line 3"):
        require_declarations(WORDS + "import os")
    with pytest.raises(NotDeclared, match=r"there is \[0 for a in 'b'\] in line 3"):
        require_declarations(WORDS + "X = [0 for a in 'b']")


def test_fields_that_several_instructions_share_and_the_struct_around_are_declared() -> None:
    shared = 'SHARED = ("a" / Byte, "b" / Byte)\nMORE = (*SHARED, "c" / Byte)\n'
    require_declarations(f"{WORDS}{shared}X = Struct(*MORE)\nY = Sets(*SHARED)\nZ = this._.length")


def test_zeros_are_declared() -> None:
    require_declarations(WORDS + "X = bytes(5)")
    for text in ("X = bytes(65)", "X = bytes(-1)", "X = bytes(5, 'a')", "bytes = 1\nX = bytes(5)"):
        with pytest.raises(NotDeclared):
            require_declarations(WORDS + text)


def test_the_kits_own_grammar_the_horns_and_the_longest_text_declare(
    grammar_text: str, horn_text: str
) -> None:
    for text in (grammar_text, horn_text, "#" * LONGEST):
        require_declarations(text)


# What would take memory or time without end.


def chained(first: str, step: str, count: int) -> str:
    """Assignments of X0 to X`count`, each made of the one before, which stands for `~`."""
    lines = [f"X{n} = {step.replace('~', f'X{n - 1}')}" for n in range(1, count + 1)]
    return "\n".join([f"X0 = {first}", *lines, ""])


FIELD = field('"speed" / Ranged(X60, 0, 255)')
NAMES = "".join(f'Y{n} = X9000 * "a"\n' for n in range(9000))

# What stands in front of the kit's own grammar, and what is changed in that to use it.
BOMBS: dict[str, tuple[str, dict[str, str]]] = {
    "tuples of tuples": (chained("0", "(~, ~)", 60), {"speed=0": "speed=X60"}),
    "dicts of dicts": (chained("0", "{1: ~, 2: ~}", 60), {"speed=0": "speed=X60"}),
    "starred tuples": (chained("(0,)", "(*~, *~)", 60), {"speed=0": "speed=X60"}),
    "constructs of constructs": (chained("Byte", 'Struct("a" / ~, "b" / ~)', 60), FIELD),
    "bits of bits": (chained("BitsInteger(1)", 'BitStruct("a" / ~, "b" / ~)', 60), {}),
    "cases of cases": (chained("Byte", "Switch(this.a, {1: ~, 2: ~})", 60), FIELD),
    "deep ranges": (chained("Byte", "Ranged(~, 0, 255)", 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "deep tuples": (chained("0", "(~,)", 3000), {"speed=0": "speed=X3000"}),
    "prose on prose": (chained("Byte", '~ * "a"', 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "names of names": (chained("Byte", "~", 9000) + NAMES, {}),
    "a deep path": (f"X = this{'.a' * 60_000}\n", {}),
    "deep brackets": (f"X = {'[' * 100_000}\n", {}),
    "deep calls": (f"X = {'Struct(' * 150}\n", {}),
    "a repeated text": ('N = this(4294967296)\nX = N * "aaaaaaaaaaaaaaaa"\n', {}),
    "a hidden width": ("X = BitsInteger(this(4294967296))\n", {ID: '"id" / X'}),
    "many numbers": (f"X = [{'1,' * 100_000}]\n", {}),
    "a very long text": (f'X = "{"a" * 3_000_000}"\n', {}),
    "a name of pages": (f'X = "{"a" * 200_000}"\n', {'NAME = "': 'NAME = X\nY = "'}),
    "many fields": (
        "",
        {ID: '"id" / BitsInteger(1)', LENGTH: '"length" / BitsInteger(7)'}
        | field(HUNDRED_TWENTY_SEVEN),
    ),
}

# In 1 GiB of memory and 30 s of computing, for all of them.
RUNNER = """
import json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
from tests.support.grammars import loaded_or_said
json.dump([str(loaded_or_said(text)) for text in json.load(sys.stdin)], sys.stdout)
"""


@pytest.mark.waits
def test_a_bomb_is_a_sentence_in_little_memory_and_time(grammar_text: str) -> None:
    texts = [
        WORDS + before + (mutated(grammar_text, changes) if changes else grammar_text)
        for before, changes in BOMBS.values()
    ]
    done = process(code=RUNNER, input=json.dumps(texts).encode())

    assert (done.returncode, done.stderr) == (0, b"")
    for name, said in zip(BOMBS, json.loads(done.stdout), strict=True):
        assert re.fullmatch(r"(?!Protocol\(|.*MemoryError).{1,399}", said), f"{name}: {said[:500]}"
        assert said.isprintable(), name
