"""Hostile grammars: wrong declarations, bombs, and random mutants of the kit's own grammar."""

from __future__ import annotations

import re
from collections.abc import Iterable
from random import Random

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.spec.codec import judge, nearest
from bilprov.spec.errors import UserError
from bilprov.spec.explain import explain
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations


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
    "a time that is none": ({"answer_deadline=100": "answer_deadline=None"}, "is None, allowed"),
    "a time that is a list": ({"stop_longest=100": "stop_longest=[1]"}, "Timing.stop_longest"),
    "a time that is true": ({"answer_longest=1000": "answer_longest=True"}, "is True, allowed"),
    "a time of nothing": ({"truncation_shortest=5": "truncation_shortest=0"}, "more than 0.001"),
    "a negative time": ({"truncation_timeout=50": "truncation_timeout=-50"}, "is -50, allowed"),
    "a time of ages": ({"truncation_longest=1000": "truncation_longest=4294967296"}, "at most"),
    "an infinite time": ({"answer_deadline=100": "answer_deadline=1e999"}, "2 to the 32nd"),
    "a time too few": ({"    stop_longest=100,\n": ""}, "missing 1 required"),
    "a time too many": ({"stop_longest=100": "stop_longest=100, x=1"}, "unexpected keyword"),
    "a baud rate of nothing": ({"baud=115200": "baud=0"}, "LineDefaults.baud is 0, allowed"),
    "a baud rate in text": ({"baud=115200": 'baud="115200"'}, "LineDefaults.baud"),
    "half a baud": ({"baud=115200": "baud=0.5"}, "allowed is a whole number"),
    "a parity that is none": ({'parity="N"': 'parity="X"'}, "allowed are N, E, O, M, S"),
    "a parity that is a list": ({'parity="N"': "parity=[]"}, "LineDefaults.parity is []"),
    "three stop bits": ({"stopbits=1)": "stopbits=3)"}, "allowed are 1, 1.5, 2"),
    "true stop bits": ({"stopbits=1)": "stopbits=True)"}, "LineDefaults.stopbits is True"),
    "a clause that is a number": ({'safety="section 2"': "safety=2"}, "Clauses.safety is 2"),
    "a clause on two lines": ({'safety="section 2"': 'safety="a\\nb"'}, "U+000A"),
    "a range in text": ({SPEED: '"speed" / Ranged(Byte, "0", 255)'}, "is '0', allowed"),
    "a range of halves": ({SPEED: '"speed" / Ranged(Byte, 0, 2.5)'}, "is 2.5, allowed"),
    "a range of truths": ({SPEED: '"speed" / Ranged(Byte, False, True)'}, "is False"),
    "a range without end": ({SPEED: '"speed" / Ranged(Byte, 0, None)'}, "is None"),
    "a range beyond its byte": ({SPEED: '"speed" / Ranged(Byte, -1, 255)'}, "cannot carry"),
    "a range of nothing known": ({SPEED: '"speed" / Ranged(5, 0, 255)'}, "allowed is a Construct"),
    "a range of a path": ({SPEED: '"speed" / Ranged(this.a.b, 0, 1)'}, "allowed is a Construct"),
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
    "a width of halves": (
        {IMPORT: f"{IMPORT}BytesInteger, ", SPEED: '"speed" / Ranged(BytesInteger(1.0), 0, 1)'},
        "is 1.0, allowed is a whole number",
    ),
    "a negative width": (
        {IMPORT: f"{IMPORT}BytesInteger, ", SPEED: '"speed" / Ranged(BytesInteger(-1), 0, 1)'},
        "is -1, allowed is 1 to 255",
    ),
    "a width in text": (
        {IMPORT: f"{IMPORT}BytesInteger, ", SPEED: '"speed" / Ranged(BytesInteger("4"), 0, 1)'},
        "is '4', allowed is a whole number",
    ),
    "bits that are a number": ({'bits="RGB"': "bits=7"}, "the bits of a field is 7"),
    "more bits than there are": ({'bits="RGB"': 'bits="RGBRGBRGB"'}, "names 9 bits, it has 8"),
    "a bit that turns the text": ({'bits="RGB"': 'bits="R\\u202eB"'}, "U+202E"),
    "a reading that is a list": ({'reading="R-led-upper-bits"': "reading=[]"}, "the reading of"),
    "an escape in a reading": ({'reading="R-led-upper-bits"': 'reading="\\x1b["'}, "U+001B"),
    "a field without a name": ({SPEED: "Ranged(Byte, 0, 255)"}, "field of Speed is None"),
    "a field with an empty name": ({SPEED: '"" / Ranged(Byte, 0, 255)'}, "is None"),
    "a field with a long name": ({SPEED: f'"{"a" * 65}" / Ranged(Byte, 0, 255)'}, "allowed are 64"),
    "a field with a tab": ({SPEED: '"a\\tb" / Ranged(Byte, 0, 255)'}, "U+0009"),
    "prose with an escape": ({'"steering strength"': '"\\x1b[2J"'}, "U+001B"),
    "prose of pages": ({'"speed that the': f'"{"x" * 1001}'}, "allowed are 1000"),
    "an instruction with an escape": ({'1: "Speed"': '1: "Sp\\x1b[31meed"'}, "U+001B"),
    "an instruction with a null": ({'1: "Speed"': '1: "Speed\\0"'}, "U+0000"),
    "an instruction of spaces": ({'1: "Speed"': '1: "  "'}, "is empty"),
    "half a character": ({'1: "Speed"': '1: "Speed\\ud800"'}, "U+D800"),
    "an unseen character": ({'1: "Speed"': '1: "Sp\\u200beed"'}, "U+200B"),
    "an instruction's document": ({'document="Stopp"': "document=5"}, "document of an Instruct"),
    "an instruction without document": ({'document="Stopp",': ""}, "missing 1 required"),
    "an effect that is a number": ({STEER: "0,"}, "the effect of an Instruction is 0"),
    "an effect with a truth": ({STEER: "Sets(steering=True),"}, "is True, allowed"),
    "an effect with a half": ({STEER: "Sets(steering=0.5),"}, "is 0.5, allowed"),
    "an effect of a construct": ({STEER: "Sets(steering=Byte),"}, "allowed is a whole number"),
    "an effect by place": ({STEER: "Sets(1),"}, "positional argument"),
    "a motion from a field": ({STEER: 'Sets(motion=From("strength")),'}, "sets motion to a number"),
    "a motion that is a list": ({STEER: "Sets(motion=[]),"}, "sets motion to []"),
    "a motion that is another": ({STEER: 'Sets(motion=Motion("up")),'}, "does not load"),
    "a factor of halves": ({"factor=-1": "factor=0.5"}, "the factor of a From is 0.5"),
    "a factor in text": ({"factor=-1": 'factor="9"'}, "the factor of a From is '9'"),
    "a field by number": ({'From("strength"))': "From(7))"}, "the field of a From is 7"),
    "power-on from a field": ({POWER: 'POWER_ON = Sets(speed=From("x"))'}, "which is not there"),
    "power-on that is a list": ({POWER: "POWER_ON = [1]"}, "POWER_ON is a list"),
    "an answer with an escape": ({'"TOO_MANY_DATA"': '"TOO\\x9bMANY"'}, "U+009B"),
    "two answers of one name": ({'"TOO_MANY_DATA"': '"too_few_data"'}, "two responses are named"),
    "an answer without outcome": ({OK: '0: Answer("OK", "valid",'}, "the outcome of OK"),
    "an answer's number": ({OK: '0: Answer(\n"OK", 5,'}, "allowed is an Outcome"),
    "an answer's code": ({OK: OK.replace("0:", "256:")}, "allowed is 0 to 255"),
    "an answer's code in halves": ({OK: OK.replace("0:", "0.5:")}, "is 0.5"),
    "an answer's code in text": ({OK: OK.replace("0:", '"0":')}, "is '0'"),
    "an answer that is none": ({"        0: Answer(": "        9: 5, 0: Answer("}, "response 9"),
    "answers of two bytes": (
        {IMPORT: f"{IMPORT}Int16ub, ", "Answers(\n    Byte": "Answers(\n    Int16ub"},
        "RESPONSE must be one byte",
    ),
    "answers of no bytes": ({"Answers(\n    Byte": "Answers(\n    7"}, "the type of a response"),
    "an ID in halves": ({'1: "Speed"': '1.5: "Speed"'}, "is 1.5, allowed"),
    "an ID that is true": ({'1: "Speed"': 'True: "Speed"'}, "is True, allowed"),
    "an ID that is none": ({'1: "Speed"': 'None: "Speed"'}, "is None, allowed"),
    "an ID that is a list": ({'1: "Speed"': '[]: "Speed"'}, "unhashable"),
    "an ID twice, once in halves": ({'2: "Forward"': '1.0: "Forward"'}, "stands twice"),
    "an instruction that is a number": ({'0: "Stop"': '9: 5, 0: "Stop"'}, "does not load"),
    "a name before a number": ({'0: "Stop"': '9: "A" / 5, 0: "Stop"'}, "unsupported operand"),
    "instructions in a list": ({"INSTRUCTIONS = {": "INSTRUCTIONS = [{"}, "cannot be parsed"),
    "a Switch by lists": ({"INSTRUCTIONS))": "{[]: Byte}))"}, "unhashable"),
    "a Switch of numbers": ({"INSTRUCTIONS))": "5))"}, "does not load"),
    "a construct of itself": ({"HEADER = BitStruct(": "HEADER = BitStruct(HEADER, "}, "Name"),
    "a signed header": ({ID: '"id" / BitsInteger(4, signed=True)'}, "must be written BitsInteger"),
    "a swapped header": ({ID: '"id" / BitsInteger(4, swapped=True)'}, "must be written"),
    "a header by a path": ({ID: '"id" / BitsInteger(this.length)'}, "cannot be used"),
    "a header of a Struct": ({ID: '"id" / BitStruct("a" / BitsInteger(4))'}, "cannot be used"),
    "a header without ID bits": (
        {ID: '"id" / BitsInteger(0)', '"length" / BitsInteger(4)': '"length" / BitsInteger(8)'},
        "is 0, allowed is 1 to 8",
    ),
    "a header of bytes": ({"HEADER = BitStruct(": "HEADER = Struct("}, "HEADER"),
    "a header of a byte": ({"HEADER = BitStruct(": "HEADER = Byte\nX = BitStruct("}, "the parts"),
    "a header with an escape": ({'"which instruction it is"': '"\\x1b"'}, "U+001B"),
    "a name with an escape": ({'NAME = "robot-car"': 'NAME = "\\x1b]0;x\\x07"'}, "NAME holds"),
    "a version that is a number": ({'VERSION = "1.1"': "VERSION = 1.1"}, "VERSION is a float"),
    "a document that turns": ({'DOCUMENT = "': 'DOCUMENT = "\\u202e'}, "DOCUMENT holds"),
    "a fault that does not stop": ({FAULTY: "FAULTY = Sets(steering=0)"}, "FAULTY does not set"),
    "a fault that turns on the spot": (
        {FAULTY: "FAULTY = Sets(motion=Motion.ROTATE_LEFT)"},
        "a faulty instruction must stop the robot",
    ),
    "a power-on that drives": (
        {POWER: "POWER_ON = Sets(motion=Motion.FORWARD, speed=9)"},
        "POWER_ON sets motion to forward; a robot must stand still",
    ),
    "a frame with a checksum": (
        {FRAME: FRAME[:-1] + ', "checksum" / Byte)'},
        "the parts of FRAME are 'header', 'data', 'checksum'; allowed are header and data",
    ),
    "a frame that is a byte": ({FRAME: "FRAME = Byte"}, "the parts of FRAME are none"),
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


def mutant(text: str, random: Random) -> str:
    """The grammar's text with one to three of its values or lines changed."""
    for _ in range(random.randint(1, 3)):
        values = [match.span() for match in VALUE.finditer(text, max(0, text.find("NAME")))]
        start, end = random.choice(values)
        other = text[slice(*random.choice(values))]
        text = text[:start] + random.choice([*PIECES, other, ""]) + text[end:]
        if random.random() < 0.1:
            lines = text.splitlines()
            lines.insert(random.randrange(20, len(lines)), lines.pop(random.randrange(20, 40)))
            text = "\n".join(lines)
    return text


def loaded_or_said(text: str) -> Protocol | str:
    """The protocol of an embedded grammar, or what is said about it."""
    try:
        return embedded(text)
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
    assert protocol.bounds
    assert protocol.longest_frame > 0
