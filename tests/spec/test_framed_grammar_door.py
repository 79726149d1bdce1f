"""The door of grammars with frames of any layout: what cannot work is refused when it is loaded.

Each row is the page's grammar of a relay board with one thing changed.
"""

from __future__ import annotations

import pytest

from bilprov.spec.protocol import GrammarError, load
from tests.support import ROOT
from tests.support.grammars import mutated

TEXT = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")
ID = '"id" / Byte'
REPLY = TEXT[TEXT.index("REPLY =") : TEXT.index("SILENT =")]  # the answer's layout
SUM = "Checksum(Byte, Sum(8), this.covered.data)"

# What is replaced by what, a piece of the sentence, and the text whose line it must tell.
WRONG: list[tuple[dict[str, str], str, str]] = [
    (
        {SUM: "Checksum(Byte, Sum(16), this.covered.data)"},
        "FRAME.sum is a Sum of up to 65535 in a type of up to 255; give it a wider type",
        '"sum" /',
    ),
    (
        {SUM: "Checksum(Byte, Crc(16, 0x1021), this.covered.data)", " Data,": " Crc, Data,"},
        "FRAME.sum is a Crc of up to 65535 in a type of up to 255",
        '"sum" /',
    ),
    (
        {"Switch(this.id,": "Switch(this.idd,"},
        "FRAME has Switch(this.idd, ...), allowed is the path to its part id",
        "FRAME =",
    ),
    (
        {"Switch(this.id,": "Switch(this.sum.id,"},
        "FRAME has Switch(this.sum.id, ...), allowed",
        "FRAME =",
    ),
    (
        {ID: f'"length" / Length(Byte), {ID}', " Data,": " Data, Length,"},
        "the data of FRAME must be written FixedSized(this.length, ...)",
        "FRAME =",
    ),
    (
        {
            ID: f'"length" / Length(Byte), {ID}',
            " Data,": " Data, Length,",
            "Const,": "Const, FixedSized,",
            "Switch(this.id, INSTRUCTIONS)": "FixedSized(this.size, Switch(this.id, INSTRUCTIONS))",
        },
        "FRAME has FixedSized(this.size, ...), allowed is the path to its part length",
        "FRAME =",
    ),
    (
        {
            REPLY: REPLY.replace("this.covered", "asked.coverd.data + this.covered"),
            " Data,": " asked, Data,",
        },
        "the check of REPLY must cover one part: write this.covered.data, or asked.covered.data",
        "REPLY =",
    ),
]


@pytest.mark.parametrize(("changes", "piece", "where"), WRONG, ids=[row[1] for row in WRONG])
def test_what_cannot_work_is_refused_with_its_line(
    changes: dict[str, str], piece: str, where: str
) -> None:
    text = mutated(TEXT, changes)
    with pytest.raises(GrammarError) as raised:
        load(text, "mine.py")
    said = str(raised.value)

    assert piece in said
    assert said.isprintable()
    if where:
        lines = [n for n, line in enumerate(text.splitlines(), 1) if where in line]
        assert f"line {lines[0]}" in said
