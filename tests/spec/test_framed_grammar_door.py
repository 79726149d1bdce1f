"""The door of grammars with frames of any layout: what cannot work is refused when it is loaded.

Each row is the page's grammar of a relay board with one thing changed.
"""

from __future__ import annotations

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import NO_ANSWER, PLAIN_ANSWER, GrammarError, load
from tests.support import ROOT
from tests.support.grammars import TIMES, mutated

MORE = {
    " Const,": " BitsInteger, BitStruct, Bytes, Const, FixedSized, GreedyBytes, "
    "Optional, Float32b,",
    " Data,": " AllOf, Ranged, AnyOf, Crc, Data, Length, asked,",
}
TEXT = mutated((ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8"), MORE)
ID = '"id" / Byte'
REPLY = TEXT[TEXT.index("REPLY =") : TEXT.index("SILENT =")]  # the answer's layout
SUM = "Checksum(Byte, Sum(8), this.covered.data)"


def read(fields: str, answer: str = "STATUS") -> dict[str, str]:
    """What gives Read other data, or another answer."""
    return {
        'Instruction(document="read", answer=STATUS)': (
            f'Instruction({fields}document="read", answer={answer})'
        )
    }


# What is replaced by what, and a piece of the sentence, which tells the line of the change.
WRONG: list[tuple[dict[str, str], str]] = [
    (
        {SUM: "Checksum(Byte, Sum(16), this.covered.data)"},
        "FRAME.sum has values up to 65535 in a type of up to 255; give it a wider type",
    ),
    (
        {'Same("address", Byte)': 'Same("adress", Byte)'},
        "REPLY.address is Same('adress'), allowed are address, id",
    ),
    ({ID: f'"copy" / Same("relay", Byte), {ID}'}, "FRAME.copy is Same('relay'), allowed are none"),
    (
        read('"n" / Byte, "text" / Bytes(this.m), '),
        "Read.text is counted by 'm'; allowed are this.n",
    ),
    (read('"text" / Bytes(0), '), "the count of Read.text is 0, allowed"),
    (read('"text" / Bytes(asked.n), '), "Read.text is counted by 'n'; allowed are a number or"),
    (
        read('"n" / Byte, ', 'Struct("text" / Bytes(asked.m))'),
        "the answer of Read.text is counted by 'm'; allowed are asked.address, asked.id, asked.n",
    ),
    (
        read('"n" / Byte, ', 'Struct("text" / Bytes(this.n))'),
        "the answer of Read.text is counted by 'n'",
    ),
    (
        {"Address(Byte, 1, 4)": "Address(Byte, 1, 400)"},
        "FRAME.address has values up to 400 in a type of up to 255",
    ),
    ({'NAME = "relay-board"': 'NAME = ""'}, "NAME is '', allowed is a text of length >= 1"),
    ({'"Toggle"': '"On now"'}, "the name of instruction 3 is 'On now', allowed is one word"),
    ({'"sum" /': '"the sum" /', ID: f'"a b" / Byte, {ID}'}, "is 'a b', allowed is one word"),
    (
        {"TIMING =": "STOPPED = AnyOf(on=0)\n\nTIMING ="},
        "nothing uses 'STOPPED'; did you mean AT_REST?",
    ),
    (
        read('"text" / Float32b, '),
        "Read.text is a floating-point number; declare its bits, Int32ub or Int32ul",
    ),
    (
        read('"text" / Optional(Byte), '),
        "the type of Read.text must be a whole number, such as Byte, or Bytes, Array, Prefixed",
    ),
    ({SUM: "Checksum(Byte, Summ(8), this.covered.data)"}, "name 'Summ' is not"),
    ({"Outcome.UNKNOWN_ID": "Outcome.UNKNOWN"}, "AttributeError: UNKNOWN"),
    ({'header="': 'headers="'}, "Unexpected keyword argument 'headers'"),
    ({"Const(b": "Const("}, "given non-bytes value"),
    (
        {"effect=Sets(on=1)": "effect=Sets(on=5)"},
        "On.effect sets on to 5, allowed is 0 to 1",
    ),
    (
        {"POWER_ON = Sets(on=0)": "POWER_ON = Sets(onn=0)"},
        "POWER_ON sets onn, allowed are on (line",
    ),
    (
        {SUM: "Checksum(Byte, Sum(8, complement=3), this.covered.data)"},
        "Sum.complement is 3, allowed is a whole number <= 2",
    ),
    (
        {"(Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM)": "Outcome.UNKNOWN_ID"},
        "SILENT is <Outcome.UNKN... 'unknown ID'>, allowed is a tuple",
    ),
    (
        {
            **read('"n" / Ranged(Byte, 0, 9, code="BAD"), '),
            "SILENT = (": "SILENT = (Outcome.BAD_DATA, ",
        },
        "Read.n has code='BAD', allowed are names of an Answer: there is none",
    ),
]
# As well, and the text whose line it must tell; "" where it tells none.
ELSEWHERE: list[tuple[dict[str, str], str, str]] = [
    (
        {"Switch(this.id,": "Switch(this.idd,"},
        "FRAME has Switch(this.idd, ...), allowed is the path to its part id",
        "FRAME =",
    ),
    (
        {ID: f'"length" / Length(Byte), {ID}'},
        "the data of FRAME must be written FixedSized(this.length, ...)",
        "FRAME =",
    ),
    (
        {
            ID: f'"length" / Length(Byte), {ID}',
            "Switch(this.id, INSTRUCTIONS)": "FixedSized(this.size, Switch(this.id, INSTRUCTIONS))",
        },
        "FRAME has FixedSized(this.size, ...), allowed is the path to its part length",
        "FRAME =",
    ),
    (
        {REPLY: REPLY.replace("this.covered", "asked.coverd.data + this.covered")},
        "the check of REPLY must cover one part: write this.covered.data, or asked.covered.data",
        "REPLY =",
    ),
    (
        {"answer_longest=1000": "answer_longest=10"},
        "Timing.answer_longest is 10, allowed is at least Timing.answer_deadline, 100",
        "TIMING =",
    ),
    (
        {'    4: "Pulse"': '    400: "Pulse"'},
        "the header cannot carry the ID 400 of 'Pulse', allowed are 0 to 255",
        '400: "Pulse"',
    ),
    (
        read('"n" / Byte, "n" / Byte, '),
        "Read has two fields named n; give one Read.n another name",
        '"n" / Byte',
    ),
    (
        read('"text" / GreedyBytes, '),
        "Read.text takes the rest of a frame without a length; declare Bytes(n), or a count",
        '"text" / GreedyBytes',
    ),
    ({REPLY: ""}, "it declares no REPLY and no RESPONSE; declare how answers look, or give", ""),
    (read("", "Byte"), "a field of the answer of Read has no name; write it", ""),
    ({"    Same,": "    Sam,"}, "cannot import name 'Sam' from 'bilprov.spec.fields' (line", ""),
    (
        {"STATE = Variables(on=Whole(0, 1))": "ON = 0"},
        "On.effect sets on, allowed are none, since STATE declares none",
        "effect=Sets(on=1)",
    ),
    (
        {"SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM)": "SILENT = (Outcome.UNKNOWN_ID,)"},
        "no response stands for bad checksum; give it an Answer in RESPONSE, or put "
        "Outcome.BAD_CHECKSUM into SILENT",
        "",
    ),
]


LIDAR = (
    """
from construct import Byte, Checksum, Const, Int16ul, RawCopy, Struct, Switch, this
from bilprov.spec.fields import Clauses, Instruction, LineDefaults, Ranged, Sum, Timing

NAME, VERSION, DOCUMENT = "lidar", "1", "TFmini, its standard frames"
INSTRUCTIONS = {
    0x59: "Distance"
    / Instruction(
        "distance" / Int16ul, "strength" / Int16ul, "mode" / Ranged(Byte, 2, 2), "spare" / Byte,
        document="frame", answer=None,
    )
    * "Measured by itself, a hundred times a second.",
}
FRAME = Struct(
    "covered"
    / RawCopy(
        Struct("head" / Const(b"\\x59"), "id" / Byte, "data" / Switch(this.id, INSTRUCTIONS))
    ),
    "sum" / Checksum(Byte, Sum(8), this.covered.data),
)
"""
    + TIMES
)


def test_frames_that_are_never_answered_need_neither_a_reply_nor_a_list_of_silent_outcomes() -> (
    None
):
    lidar = load(LIDAR, "lidar.py")
    measured = judge(lidar, bytes.fromhex("59 59 2c 01 64 00 02 00 45"))
    wrong = judge(lidar, bytes.fromhex("59 59 2c 01 64 00 02 00 46"))

    assert (measured.valid, dict(measured.fields)["distance"]) == (True, 300)
    assert wrong.outcome is Outcome.BAD_CHECKSUM
    assert {*lidar.answers.values()} <= {NO_ANSWER, PLAIN_ANSWER}


def test_names_of_a_grammars_own_are_let_alone() -> None:
    load(mutated(TEXT, {"TIMING =": "LINES = 3\nSTATES = Whole(0, LINES)\nX = STATES\nTIMING ="}))


def refused(changes: dict[str, str], piece: str) -> tuple[str, str]:
    """The grammar with the changes, and the sentence that refuses it, which holds the piece."""
    text = mutated(TEXT, changes)
    with pytest.raises(GrammarError) as raised:
        load(text, "mine.py")
    said = str(raised.value)
    assert piece in said
    assert said.isprintable()
    return text, said


@pytest.mark.parametrize(("changes", "piece"), WRONG, ids=[row[1] for row in WRONG])
def test_what_cannot_work_is_refused_with_its_line(changes: dict[str, str], piece: str) -> None:
    text, said = refused(changes, piece)

    lines = zip(TEXT.splitlines(), text.splitlines(), strict=False)
    changed = next(n for n, (before, after) in enumerate(lines, 1) if before != after)
    assert f"line {changed}" in said


@pytest.mark.parametrize(
    ("changes", "piece", "where"), ELSEWHERE, ids=[row[1] for row in ELSEWHERE]
)
def test_what_cannot_work_is_refused_with_the_line_of_its_declaration(
    changes: dict[str, str], piece: str, where: str
) -> None:
    text, said = refused(changes, piece)

    if where:
        assert f"line {1 + text[: text.index(where)].count(chr(10))}" in said
