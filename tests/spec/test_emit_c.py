"""The C header that is generated from the grammar."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.checks import Crc
from bilprov.spec.codec import build
from bilprov.spec.emit.c import c_header
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.drawn_layouts import drawn_layout
from tests.support.firmware import needs
from tests.support.grammars import checked_digits
from tests.vectors import HEADERS, LINE, LONGEST_FRAME, RESPONSES, TIMING
from tests.vectors_checks import CHECKS, DIGITS, CheckVector


def constants(text: str, prefix: str = "ROBOT_CAR") -> dict[str, int]:
    """The header's numbers by their names, without the prefix."""
    found = re.findall(rf"^#define {prefix}_(\w+) (0x[0-9a-f]+|\d+)", text, re.MULTILINE)
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


def framed(name: str) -> Protocol:
    return load_protocol(name if "." not in name else str(ROOT / "examples" / name))


FRAMED = ["modbus-rtu", "stk500v1", "dynamixel1", "feetech.py", "relay_board.py", "roboclaw.py"]
GCC = needs("gcc", package="gcc libc6-dev")


def require_compiled(folder: Path, header: str, text: str, *command: str) -> None:
    """A C file that includes the header compiles without a warning."""
    (folder / "protocol.h").write_text(header, encoding="utf-8")
    source = folder / "use.c"
    source.write_text(f'#include "protocol.h"\n#include "protocol.h"\n{text}\n')
    words = (*command, "-pedantic", "-Wall", "-Wextra", "-Werror", "-c", "-o", "/dev/null", source)
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@GCC
@pytest.mark.parametrize("name", FRAMED)
def test_every_constant_of_a_framed_grammar_is_one_of_c(name: str, tmp_path: Path) -> None:
    text = c_header(framed(name))
    names = re.findall(r"^#define (\w+) (.*?)(?: /\*.*)?$", text, re.MULTILINE)
    uses = [
        f"const unsigned char b{at}[] = {name};" if "{" in value else f"long n{at} = {name};"
        for at, (name, value) in enumerate(names)
    ]
    require_compiled(tmp_path, text, "\n".join(uses), "gcc", "-std=c89")


@pytest.mark.sample(8)
@GCC
@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_the_header_of_any_layout_compiles(seed: int, tmp_path: Path) -> None:
    header = c_header(drawn_layout(seed).protocol)
    require_compiled(tmp_path, header, "int nothing;", "gcc", "-std=c89")


def test_what_is_sent_without_a_check_is_marked() -> None:
    header = c_header(framed("roboclaw.py"))
    marked = [name for name in constants(header, "ROBOCLAW") if name.endswith("_UNCHECKED")]
    assert marked == ["MAIN_BATTERY_UNCHECKED", "CURRENTS_UNCHECKED"]


def test_a_request_is_built_from_the_header_alone() -> None:
    protocol = load_protocol("modbus-rtu")
    found = constants(c_header(protocol), "MODBUS_RTU")
    data, write = found["FRAME_HEAD"], "WRITE_SINGLE_REGISTER"
    end = data + found[f"{write}_LENGTH"] + found["FRAME_TAIL"]
    frame = bytearray(end)
    frame[found["FRAME_ADDRESS_OFFSET"]] = 17
    frame[found["FRAME_ID_OFFSET"]] = found[f"{write}_ID"]

    def put(at: int, value: int, name: str) -> None:
        order = "little" if found[f"{name}_LITTLE_ENDIAN"] else "big"
        frame[at : at + 2] = value.to_bytes(2, order)  # type: ignore[arg-type]

    for name, value in (("REGISTER", 1), ("VALUE", 3)):
        put(data + found[f"{write}_{name}_OFFSET"], value, f"{write}_{name}")
    covered = frame[found["FRAME_CHECK_FIRST"] : end - found["FRAME_CHECK_LAST"]]
    put(end - found["FRAME_CRC_FROM_END"], declared_crc(found)(covered), "FRAME_CRC")

    assert frame == build(
        protocol, "WriteSingleRegister", {"address": 17, "register": 1, "value": 3}
    )


def declared_crc(found: dict[str, int]) -> Crc:
    """The CRC that the constants of a header describe."""
    words = ("WIDTH", "POLY", "INIT", "REFLECTED", "XOROUT", "REFOUT")
    width, poly, init, reflected, xorout, refout = (found[f"FRAME_CHECK_CRC_{w}"] for w in words)
    return Crc(width, poly, init, bool(reflected), xorout, bool(refout))


@pytest.mark.parametrize(
    "vector", [one for one in CHECKS if one.declared.startswith("Crc")], ids=str
)
def test_each_published_crc_is_described_by_the_header(vector: CheckVector) -> None:
    header = c_header(checked_digits(vector, "big")[0])
    prefix = header.partition("#ifndef ")[2].partition("_PROTOCOL_H")[0]

    assert declared_crc(constants(header, prefix))(DIGITS) == vector.value


def test_the_header_has_what_a_request_with_a_length_and_a_register_is_built_of() -> None:
    text = c_header(framed("feetech.py"))
    for constant in (
        "FRAME_LENGTH_ALSO 2",
        "FRAME_CHECK_SUM_COMPLEMENT 0x01",
        "REGISTER_GOAL_POSITION 42",
        "REGISTER_GOAL_POSITION_LITTLE_ENDIAN 1",
    ):
        assert f"#define FEETECH_STS3215_{constant}" in text


@needs("avr-gcc", package="gcc-avr")
@pytest.mark.parametrize("language", ["-std=c89", "-xc++"])
def test_it_compiles_without_a_warning(protocol: Protocol, tmp_path: Path, language: str) -> None:
    require_compiled(tmp_path, c_header(protocol), "int led = ROBOT_CAR_LED;", "avr-gcc", language)
