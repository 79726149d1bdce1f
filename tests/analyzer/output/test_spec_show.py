"""`spec show` of a grammar with frames of its own layout: effects, flags and IDs."""

from __future__ import annotations

from pathlib import Path

from tests.support import ROOT
from tests.support.commands import command
from tests.support.grammars import mutated

TEXT = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")


def test_factors_flags_and_decimal_ids_are_shown(tmp_path: Path) -> None:
    sets = '"level" / Byte, document="open", effect=Sets(level=From("level", factor=258)),'
    changes = {
        '1: "On"': '16: "On"',
        'document="open", answer=STATUS, effect=Sets(on=1)': (
            f'{sets} answer=Struct("alarm" / FlagsEnum(Byte, hot=1, slow=4))'
        ),
        "Variables(": "Variables(level=Whole(0, 65790), ",
        " Const,": " Const, FlagsEnum,",
        " Data,": " Data, From,",
    }
    grammar = tmp_path / "mine.py"
    grammar.write_text(mutated(TEXT, changes), encoding="utf-8")

    shown = command("spec", "show", "--grammar", str(grammar), COLUMNS="200")

    assert shown.returncode == 0, shown.stderr
    assert b"level = 258 x level" in shown.stdout
    assert b"alarm=0..5 (hot slow)" in shown.stdout
    assert b"  16  On " in shown.stdout
