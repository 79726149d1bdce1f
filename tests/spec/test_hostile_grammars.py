"""Hostile grammars: each ends in one short sentence, within bounded memory and work.

They are loaded as the grammar inside a capture is: it must first hold nothing but declarations. A
grammar that the user names is loaded without that; the same sentences come for it.
"""

from __future__ import annotations

import json

import pytest

from bilprov.spec.protocol import GrammarError, load
from bilprov.spec.safe_grammar import NotDeclared
from tests.support.commands import process
from tests.support.grammars import embedded, mutated

LED = '"rgb"\n        / Ranged(Byte, 0, 7, bits="RGB", reading="R-led-upper-bits")'
SPEED = '"speed" / Ranged(Byte, 0, 255)'
STEER = 'Sets(steering=From("strength")),'
POWER = "POWER_ON = Sets(motion=Motion.STOPPED, speed=0, steering=0, led=0)"
FAULTY = "FAULTY = Sets(motion=Motion.STOPPED, steering=0)"
FRAME = 'FRAME = Struct("header" / HEADER, "data" / Switch(this.header.id, INSTRUCTIONS))'
IMPORT = "from construct import "
OK = '0: Answer(\n            "OK", Outcome.VALID,'
ID = '"id" / BitsInteger(4)'

# What is replaced by what, and a piece of the sentence.
WRONG: dict[str, tuple[dict[str, str], str]] = {
    "a time that is a text": ({"truncation_timeout=50": 'truncation_timeout="a"'}, "Timing.trunc"),
    "a time of nothing": ({"truncation_shortest=5": "truncation_shortest=0"}, "more than 0.001"),
    "an infinite time": ({"answer_deadline=100": "answer_deadline=1e999"}, "2 to the 32nd"),
    "a time too few": ({"    stop_longest=100,\n": ""}, "missing 1 required"),
    "a baud rate of nothing": ({"baud=115200": "baud=0"}, "LineDefaults.baud is 0, allowed"),
    "a baud rate in text": ({"baud=115200": 'baud="115200"'}, "LineDefaults.baud"),
    "a parity that is none": ({'parity="N"': 'parity="X"'}, "allowed are N, E, O, M, S"),
    "a clause that is a number": ({'safety="section 2"': "safety=2"}, "Clauses.safety is 2"),
    "a clause on two lines": ({'safety="section 2"': 'safety="a\\nb"'}, "U+000A"),
    "a range in text": ({SPEED: '"speed" / Ranged(Byte, "0", 255)'}, "is '0', allowed"),
    "a range of halves": ({SPEED: '"speed" / Ranged(Byte, 0, 2.5)'}, "is 2.5, allowed"),
    "a range beyond its byte": ({SPEED: '"speed" / Ranged(Byte, -1, 255)'}, "cannot carry"),
    "a range of nothing known": ({SPEED: '"speed" / Ranged(5, 0, 255)'}, "allowed is a Construct"),
    "a range of a Struct": ({SPEED: '"speed" / Ranged(Struct(), 0, 1)'}, "in bytes is 0"),
    "a range of a Switch": (
        {SPEED: '"speed" / Ranged(Switch(this.x, {1: Byte}, default=Byte), 0, 1)'},
        "cannot be used",
    ),
    "a range of an answer": (
        {SPEED: '"speed" / Ranged(Answers(Byte, {}), 0, 1)'},
        "must be a whole number",
    ),
    "a range of bits": (
        {SPEED: '"speed" / Ranged(BitsInteger(4), 0, 1)'},
        "must be a whole number",
    ),
    "bytes by a path": (
        {IMPORT: f"{IMPORT}BytesInteger, ", SPEED: '"speed" / Ranged(BytesInteger(this), 0, 1)'},
        "cannot be used",
    ),
    "bits that are a number": ({'bits="RGB"': "bits=7"}, "the bits of a field is 7"),
    "more bits than there are": ({'bits="RGB"': 'bits="RGBRGBRGB"'}, "names 9 bits, it has 8"),
    "a bit that turns the text": ({'bits="RGB"': 'bits="R\\u202eB"'}, "U+202E"),
    "a reading that is a list": ({'reading="R-led-upper-bits"': "reading=[]"}, "the reading of"),
    "an escape in a reading": ({'reading="R-led-upper-bits"': 'reading="\\x1b["'}, "U+001B"),
    "a field without a name": ({SPEED: "Ranged(Byte, 0, 255)"}, "field of Speed is None"),
    "a field with a long name": ({SPEED: f'"{"a" * 65}" / Ranged(Byte, 0, 255)'}, "allowed are 64"),
    "a field with a tab": ({SPEED: '"a\\tb" / Ranged(Byte, 0, 255)'}, "U+0009"),
    "prose with an escape": ({'"steering strength"': '"\\x1b[2J"'}, "U+001B"),
    "prose of pages": ({'"speed that the': f'"{"x" * 1001}'}, "allowed are 1000"),
    "an instruction with an escape": ({'1: "Speed"': '1: "Sp\\x1b[31meed"'}, "U+001B"),
    "an instruction of spaces": ({'1: "Speed"': '1: "  "'}, "is empty"),
    "an instruction's document": ({'document="Stopp"': "document=5"}, "document of an Instruct"),
    "an effect that is a number": ({STEER: "0,"}, "the effect of an Instruction is 0"),
    "an effect with a truth": ({STEER: "Sets(steering=True),"}, "is True, allowed"),
    "a motion from a field": ({STEER: 'Sets(motion=From("strength")),'}, "sets motion to a number"),
    "a motion that is a list": ({STEER: "Sets(motion=[]),"}, "sets motion to []"),
    "a factor of halves": ({"factor=-1": "factor=0.5"}, "the factor of a From is 0.5"),
    "a field by number": ({'From("strength"))': "From(7))"}, "the field of a From is 7"),
    "power-on from a field": ({POWER: 'POWER_ON = Sets(speed=From("x"))'}, "which is not there"),
    "power-on that is a list": ({POWER: "POWER_ON = [1]"}, "POWER_ON is a list"),
    "an answer with an escape": ({'"TOO_MANY_DATA"': '"TOO\\x9bMANY"'}, "U+009B"),
    "two answers of one name": ({'"TOO_MANY_DATA"': '"too_few_data"'}, "two responses are named"),
    "an answer without outcome": ({OK: '0: Answer("OK", "valid",'}, "the outcome of OK"),
    "an answer's code": ({OK: OK.replace("0:", "256:")}, "allowed is 0 to 255"),
    "an answer's code in halves": ({OK: OK.replace("0:", "0.5:")}, "is 0.5"),
    "an answer that is none": ({"        0: Answer(": "        9: 5, 0: Answer("}, "response 9"),
    "answers of two bytes": (
        {IMPORT: f"{IMPORT}Int16ub, ", "Answers(\n    Byte": "Answers(\n    Int16ub"},
        "RESPONSE must be one byte",
    ),
    "answers of no bytes": ({"Answers(\n    Byte": "Answers(\n    7"}, "the type of a response"),
    "an ID in halves": ({'1: "Speed"': '1.5: "Speed"'}, "is 1.5, allowed"),
    "an ID that is a list": ({'1: "Speed"': '[]: "Speed"'}, "unhashable"),
    "an ID twice, once in halves": ({'2: "Forward"': '1.0: "Forward"'}, "stands twice"),
    "a name before a number": ({'0: "Stop"': '9: "A" / 5, 0: "Stop"'}, "unsupported operand"),
    "instructions in a list": ({"INSTRUCTIONS = {": "INSTRUCTIONS = [{"}, "cannot be parsed"),
    "a construct of itself": ({"HEADER = BitStruct(": "HEADER = BitStruct(HEADER, "}, "Name"),
    "a signed header": ({ID: '"id" / BitsInteger(4, signed=True)'}, "must be written BitsInteger"),
    "a header by a path": ({ID: '"id" / BitsInteger(this.length)'}, "cannot be used"),
    "a header of a Struct": ({ID: '"id" / BitStruct("a" / BitsInteger(4))'}, "cannot be used"),
    "a header without ID bits": (
        {ID: '"id" / BitsInteger(0)', '"length" / BitsInteger(4)': '"length" / BitsInteger(8)'},
        "is 0, allowed is 1 to 8",
    ),
    "a header of a byte": ({"HEADER = BitStruct(": "HEADER = Byte\nX = BitStruct("}, "the parts"),
    "a header with an escape": ({'"which instruction it is"': '"\\x1b"'}, "U+001B"),
    "a name with an escape": ({'NAME = "robot-car"': 'NAME = "\\x1b]0;x\\x07"'}, "NAME holds"),
    "a version that is a number": ({'VERSION = "1.1"': "VERSION = 1.1"}, "VERSION is a float"),
    "a document that turns": ({'DOCUMENT = "': 'DOCUMENT = "\\u202e'}, "DOCUMENT holds"),
    "a fault that does not stop": ({FAULTY: "FAULTY = Sets(steering=0)"}, "FAULTY does not set"),
    "a power-on that drives": (
        {POWER: "POWER_ON = Sets(motion=Motion.FORWARD, speed=9)"},
        "POWER_ON sets motion to forward; a robot must stand still",
    ),
    "a frame with a checksum": (
        {FRAME: FRAME[:-1] + ', "checksum" / Byte)'},
        "the parts of FRAME are 'header', 'data', 'checksum'; allowed are header and data",
    ),
    "no frame": ({FRAME: ""}, "it declares no FRAME"),
    "a call that hides a number": (
        {"POWER_ON = Sets": "X = this(4294967296)\nPOWER_ON = Sets"},
        "there is a Call",
    ),
}


def chained(first: str, step: str, count: int) -> str:
    """Assignments of X0 to X`count`, each made of the one before, which stands for `~`."""
    lines = [f"X{n} = {step.replace('~', f'X{n - 1}')}" for n in range(1, count + 1)]
    return "\n".join([f"X0 = {first}", *lines, ""])


def chained_prose(name: str, count: int) -> str:
    """As many assignments of one declared name with some prose."""
    return "".join(f'Y{n} = {name} * "a"\n' for n in range(count))


WORDS = (
    "from construct import BitsInteger, BitStruct, Byte, Struct, Switch, this\n"
    "from bilprov.spec.fields import *\n"
).replace("*", "Answer, Answers, Instruction, Ranged, Sets")

FIELD = {SPEED: '"speed" / Ranged(X60, 0, 255)'}
EFFECT = {"speed=0": "speed=X60"}

# What would take memory or time without end: a text that stands in front of the kit's own grammar,
# and what is changed in that grammar to use it.
BOMBS: dict[str, tuple[str, dict[str, str]]] = {
    "tuples of tuples": (chained("0", "(~, ~)", 60), EFFECT),
    "lists of lists": (chained("0", "[~, ~, ~]", 60), EFFECT),
    "dicts of dicts": (chained("0", "{1: ~, 2: ~}", 60), EFFECT),
    "constructs of constructs": (chained("Byte", 'Struct("a" / ~, "b" / ~)', 60), FIELD),
    "bits of bits": (chained("BitsInteger(1)", 'BitStruct("a" / ~, "b" / ~)', 60), {}),
    "cases of cases": (chained("Byte", "Switch(this.a, {1: ~, 2: ~})", 60), FIELD),
    "ranges of ranges": (chained("Byte", "Ranged(~, 0, 255)", 60), FIELD),
    "deep ranges": (chained("Byte", "Ranged(~, 0, 255)", 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "deep tuples": (chained("0", "(~,)", 3000), {"speed=0": "speed=X3000"}),
    "prose on prose": (chained("Byte", '~ * "a"', 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "names of names": (chained("Byte", "~", 9000) + chained_prose("X9000", 9000), {}),
    "a deep path": (f"X = this{'.a' * 60_000}\n", {}),
    "deep brackets": (f"X = {'[' * 100_000}\n", {}),
    "deep braces": (f"X = {'{1:' * 150}\n", {}),
    "deep calls": (f"X = {'Struct(' * 150}\n", {}),
    "a repeated text": ('X = this(4294967296) * "aaaaaaaaaaaaaaaa"\n', {}),
    "a repeated text by a name": ('N = this(4294967296)\nX = N * "aaaaaaaaaaaaaaaa"\n', {}),
    "a hidden width": ("X = BitsInteger(this(4294967296))\n", {ID: '"id" / X'}),
    "many numbers": (f"X = [{'1,' * 100_000}]\n", {}),
    "many keys": (f"X = {{{''.join(f'{n}:0,' for n in range(30_000))}}}\n", {}),
    "a very long text": (f'X = "{"a" * 3_000_000}"\n', {}),
    "a name of pages": (f'X = "{"a" * 200_000}"\n', {'NAME = "': 'NAME = X\nY = "'}),
    "many fields": (
        "".join(f'F{n} = "f{n}" / Ranged(Byte, 0, 255)\n' for n in range(127)),
        {
            ID: '"id" / BitsInteger(1)',
            '"length" / BitsInteger(4)': '"length" / BitsInteger(7)',
            SPEED: ", ".join(f"F{n}" for n in range(127)),
        },
    ),
}


def bomb(text: str, name: str) -> str:
    """The kit's own grammar with one of the bombs in it."""
    before, changes = BOMBS[name]
    return f"{WORDS}{before}{mutated(text, changes) if changes else text}"


def sentence(text: str, *, declared: bool = True) -> str:
    """What is said about a grammar that cannot be used: one line, short, and all of it prints."""
    with pytest.raises((NotDeclared, GrammarError)) as raised:
        (embedded if declared else load)(text)
    said = str(raised.value)
    assert said.isprintable()
    assert len(said) < 400
    return said


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_declaration_is_one_sentence(grammar_text: str, name: str) -> None:
    changes, piece = WRONG[name]

    assert piece in sentence(mutated(grammar_text, changes))


@pytest.mark.parametrize("name", WRONG)
def test_the_same_holds_for_a_grammar_that_the_user_names(grammar_text: str, name: str) -> None:
    text = mutated(grammar_text, WRONG[name][0])
    if "this(" not in text or "this(4294967296)" not in text:  # Python itself allows that
        sentence(text, declared=False)


# What only a grammar that runs can hold.
RUN = {
    "a time that is not a number": ({"stop_longest=100": 'stop_longest=float("nan")'}, "is nan"),
    "an infinite time": ({"stop_longest=100": 'stop_longest=float("inf")'}, "is inf"),
    "a number of pages": ({"stop_longest=100": "stop_longest=10**5000"}, "of 16610 bits"),
    "a factor of pages": ({"factor=-1": "factor=10**5000"}, "of 16610 bits"),
    "an error of pages": ({'NAME = "': 'raise ValueError("\\x1b[2J" * 9999)\nNAME = "'}, "x1b"),
    "a way out": ({'NAME = "': 'raise SystemExit(0)\nNAME = "'}, "SystemExit"),
    "a recursion": ({'NAME = "': '(f := lambda: f())()\nNAME = "'}, "RecursionError"),
    "a construct that reads nothing known": (
        {SPEED: '"speed" / Ranged(__import__("construct").Float32b, 0, 1)'},
        "must be a whole number",
    ),
    "prose of bytes": ({'"steering strength"': 'b"x"'}, "is b'x', allowed is a text"),
}


@pytest.mark.parametrize("name", RUN)
def test_a_grammar_that_runs_ends_in_a_sentence_too(grammar_text: str, name: str) -> None:
    changes, piece = RUN[name]

    assert piece in sentence(mutated(grammar_text, changes), declared=False)


def test_the_sentence_tells_the_line(grammar_text: str) -> None:
    line = 1 + grammar_text.splitlines().index("TIMING = Timing(")

    said = sentence(mutated(grammar_text, WRONG["a time that is a text"][0]))

    assert said == (
        "the grammar grammar cannot be used: Timing.truncation_timeout in ms is 'a', "
        f"allowed is a number (line {line})"
    )


def test_pythons_own_remarks_about_a_grammar_are_not_shown(
    grammar_text: str, recwarn: pytest.WarningsRecorder
) -> None:
    said = sentence(f"{grammar_text}\nX = 1('\\d')\n")

    assert "there is a Call" in said
    load(f'{grammar_text}\nX = "\\d"\n')
    assert not recwarn.list


MEMORY, SECONDS = 1 << 30, 30  # bytes of address space; of computing, for all of them

RUNNER = f"""
import json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}))
resource.setrlimit(resource.RLIMIT_CPU, ({SECONDS}, {SECONDS}))
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations
said = []
for text in json.load(sys.stdin):
    try:
        require_declarations(text)
        load(text)
        said.append("")
    except (NotDeclared, UserError) as error:
        said.append(str(error))
json.dump(said, sys.stdout)
"""


@pytest.fixture(scope="module")
def bombs_said(grammar_text: str) -> dict[str, str]:
    """What is said about each bomb, by a process that has little memory and time."""
    texts = [bomb(grammar_text, name) for name in BOMBS]
    done = process(code=RUNNER, input=json.dumps(texts).encode())
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == b""
    return dict(zip(BOMBS, json.loads(done.stdout), strict=True))


@pytest.mark.waits
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_a_sentence_in_little_memory_and_time(
    bombs_said: dict[str, str], name: str
) -> None:
    said = bombs_said[name]

    assert said
    assert said.isprintable()
    assert len(said) < 400
    assert "MemoryError" not in said
