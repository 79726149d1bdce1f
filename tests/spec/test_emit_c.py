"""The C header that is generated from the grammar."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from bilprov.spec.emit.c import c_header
from bilprov.spec.protocol import Protocol, load
from tests.support.firmware import needs
from tests.vectors import HEADERS, LINE, LONGEST_FRAME, RESPONSES, TIMING


def constants(text: str) -> dict[str, int]:
    """The header's numbers by their names, without the prefix."""
    found = re.findall(r"^#define ROBOT_CAR_(\w+) (0x[0-9a-f]+|\d+)\b", text, re.MULTILINE)
    assert len(found) == len(dict(found)), "a name is defined twice"
    return {name: int(value, 0) for name, value in found}


def words(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper()


def test_it_says_what_the_document_says(protocol: Protocol) -> None:
    found = constants(c_header(protocol))

    for row in HEADERS:
        assert found[f"{words(row.name)}_ID"] == row.id
        assert found[f"{words(row.name)}_LENGTH"] == row.length
        assert found[words(row.name)] == row.id << 4 | row.length
    for response in RESPONSES:
        assert found[f"ANSWER_{response.name}"] == response.code
    assert found["LED_RGB_MAX"] == 7
    assert (found["LED_RGB_R"], found["LED_RGB_G"], found["LED_RGB_B"]) == (4, 2, 1)
    assert (found["ID_SHIFT"], found["ID_MASK"]) == (4, 0xF0)
    assert (found["LENGTH_SHIFT"], found["LENGTH_MASK"]) == (0, 0x0F)
    assert found["MAX_FRAME"] == LONGEST_FRAME == found["MAX_DATA"] + 1
    assert found["BAUD"] == LINE["baud"]
    assert found["TRUNCATION_TIMEOUT_MS"] == TIMING["truncation_timeout"]


def test_another_grammar_gives_another_header(horn: Protocol) -> None:
    found = constants(c_header(horn))

    assert (found["HORN"], found["HORN_SOUND_MIN"], found["HORN_SOUND_MAX"]) == (0x91, 0, 3)


def test_prose_cannot_end_its_comment(grammar_text: str) -> None:
    hostile = grammar_text.replace("steering strength", "*/ int x; /* #define STOP 9 \\\\")

    text = c_header(load(hostile))

    assert hostile != grammar_text
    assert "*/ int" not in text
    assert constants(text)["STOP"] == 0


@needs("avr-gcc", package="gcc-avr")
@pytest.mark.parametrize("language", ["-std=c89", "-xc++"])
def test_it_compiles_without_a_warning(protocol: Protocol, tmp_path: Path, language: str) -> None:
    header = tmp_path / "protocol.h"
    header.write_text(c_header(protocol), encoding="utf-8")
    use = tmp_path / "use.c"
    use.write_text('#include "protocol.h"\n#include "protocol.h"\nint led = ROBOT_CAR_LED;\n')

    flags = f"-pedantic -Wall -Wextra -Werror {language} -c -o /dev/null".split()
    done = subprocess.run(["avr-gcc", *flags, use], capture_output=True, text=True, check=False)

    assert (done.returncode, done.stderr) == (0, "")
