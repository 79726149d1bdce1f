"""Registers with names: of a servo whose grammar imports that of its protocol, and of a meter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from bilprov.analyzer.decode.batch import Records
from bilprov.analyzer.decode.columns import ColumnBatch
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.protocol import GrammarError, Protocol
from tests.support import ROOT
from tests.support.decoding import conversation

pytestmark = pytest.mark.usefixtures("columns_at_once")

FEETECH = ROOT / "examples" / "feetech.py"
SERVO = load_protocol(str(FEETECH))
# A request, its answer, and the registers in each; those of the document of the servos.
POSITION = "FFFF 01 04 02 38 02 BE", "FFFF 01 04 00 18 05 DD"
MOVE = "FFFF 01 09 03 2A 00 08 00 00 E8 03 D5"
BOTH = "FFFF FE 0A 83 2A 02 01 00 02 02 03 02 3E"


@pytest.fixture
def grammar(tmp_path: Path) -> Callable[[str], Protocol]:
    """Loads a text as a grammar file."""

    def loaded(text: str) -> Protocol:
        path = tmp_path / f"grammar{len(list(tmp_path.iterdir()))}.py"
        path.write_text(text, encoding="utf-8")
        return load_protocol(str(path))

    return loaded


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


MOVED = frame(MOVE), frame("FFFF 01 02 00 FC")
# Exchanges, and which rows filters of registers choose.
FILTERS = [
    (
        [MOVED, (frame(POSITION[0]), frame(POSITION[1]))],
        {
            "goal_position == 2048": [True, False, False, False],
            "goal_velocity != 1000": [False] * 4,
            "1300 < present_position": [False, False, False, True],
            "fields.torque == on": [False] * 4,
        },
    ),
    (
        [(frame(BOTH), b""), MOVED],  # a register of several servos
        {
            "goal_position == 512": [True, False, False],
            "goal_position == 515": [True, False, False],
            "goal_position > 500": [True, True, False],
            "not goal_position == 512": [False, True, True],
            "goal_position < goal_velocity": [False] * 3,
            "goal_velocity < goal_position and size == 2": [False] * 3,
            "goal_time < goal_position": [False, True, False],
            "goal_position & 3 == 3": [True, False, False],
        },
    ),
]


@pytest.mark.parametrize(("exchanges", "filters"), FILTERS)
def test_filters_find_registers(
    exchanges: list[tuple[bytes, bytes]], filters: dict[str, list[bool]]
) -> None:
    (batch,) = StreamDecoder(SERVO).feed(conversation(exchanges))
    assert isinstance(batch, ColumnBatch)

    for found in (batch, Records(list(batch.records()))):
        for text, rows in filters.items():
            chosen = compile_filter(text, SERVO).selection(found)
            assert found.in_order(chosen).tolist() == rows, text


def test_an_imported_declaration_may_be_replaced_unless_others_need_it(
    grammar: Callable[[str], Protocol],
) -> None:
    star = "from bilprov.spec.grammars.modbus_rtu import *\n"
    assert grammar(star + 'NAME = "other"\n').name == "other"
    assert grammar(star).sha256 != load_protocol("modbus-rtu").sha256  # comments are left out
    with pytest.raises(GrammarError, match="cannot declare CRC, since declarations that it"):
        grammar(star + 'CRC = "mine"\n')
    with pytest.raises(GrammarError, match="cannot import name 'NOTHING'"):
        grammar("from bilprov.spec.grammars.modbus_rtu import NOTHING\n")
