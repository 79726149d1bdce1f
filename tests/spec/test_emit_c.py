"""The C header that is generated from the grammar."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.checks import Crc
from bilprov.spec.codec import build
from bilprov.spec.emit.c import c_header
from bilprov.spec.emit.python import RENEW, method_names, parameter_names, python_stub, snake_case
from bilprov.spec.protocol import Protocol, load
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


@needs("avr-gcc", package="gcc-avr")
@pytest.mark.parametrize("language", ["-std=c89", "-xc++"])
def test_it_compiles_without_a_warning(protocol: Protocol, tmp_path: Path, language: str) -> None:
    require_compiled(tmp_path, c_header(protocol), "int led = ROBOT_CAR_LED;", "avr-gcc", language)


# -- the stub beside `robot.py`: a type checker sees the instructions of the grammar ---------------

STUB = ROOT / "analyzer" / "client" / "robot.pyi"


def test_the_committed_stub_is_what_the_grammar_gives(protocol: Protocol) -> None:
    written = STUB.read_text(encoding="utf-8")

    assert written == python_stub(protocol), f"the grammar has changed: run `{RENEW}`"


def require_left_alone(stub: str, folder: Path) -> None:
    """Neither ruff's formatter nor its rules find anything to change in the stub."""
    file = folder / "device.pyi"
    file.write_text(stub, encoding="utf-8")
    style = ["--isolated", "--line-length", "100", file]
    for words in (["format", "--diff"], ["check", "--select", "E,F,W"]):
        command = [sys.executable, "-m", "ruff", *words, *style]
        done = subprocess.run(command, capture_output=True)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("grammar", ["modbus-rtu", "stk500v1", "dynamixel1"])
def test_the_stub_of_a_grammar_is_in_the_style_of_the_code(grammar: str, tmp_path: Path) -> None:
    require_left_alone(python_stub(load_protocol(grammar)), tmp_path)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("RotateLeft", "rotate_left"),
        ("LEDOn", "led_on"),
        ("Speed2Fast", "speed2_fast"),
        ("Go-Round", "go_round"),
        ("BackaÅt", "backa_åt"),
        ("Ａ", "a"),
        ("3rd", "do_3rd"),
        ("!", "do_"),
        ("_private", "do_private"),
    ],
)
def test_names_are_written_as_python_writes_them(name: str, word: str) -> None:
    assert snake_case(name, "do_") == word
    assert word.isidentifier()


def test_no_two_instructions_or_fields_have_one_name_and_none_is_a_keyword(horn_text: str) -> None:
    text = horn_text.replace('9: "Horn"', '9: "Rotate-Left"').replace(
        '"sound" / Ranged(Byte, 0, 3) * "which of the four sounds, 0 is silence",',
        '"self" / Ranged(Byte, 0, 3), "a-b" / Ranged(Byte, 0, 1), "a_b" / Ranged(Byte, 0, 1), '
        '"if" / Ranged(Byte, 0, 1),',
    )
    protocol = load(text)
    names = method_names(protocol)

    assert names["rotate_left"].id == 7
    assert names["rotate_left_"].id == 9
    assert list(parameter_names(names["rotate_left_"])) == ["self_", "a_b", "a_b_", "if_"]


# What a type checker sees of the car's methods, and of what is read by a register's name.
SEEN = """\
from bilprov import Robot
from bilprov.conformance.pytest_plugin.session import Client
from servo import Servo

def drive(robot: Robot, client: Client) -> float:
    robot.speed(127)
    robot.led(rgb=5)
    client.rotate_left()
    robot.speed("x")  # refused: arg-type
    robot.stop(1)  # refused: call-arg
    robot.speed()  # refused: call-arg
    robot.sped(1)  # refused: attr-defined
    client.led(rgb=None)  # refused: arg-type
    return robot.speed(speed=3).latency

def where(servo: Servo) -> int:
    raw: bytes = servo.read(42, 2)
    servo.read(42)  # refused: call-overload
    servo.read("goal_position", size=2).decode  # refused: union-attr
    return servo.read("goal_position", address=3) + 1
"""


@pytest.mark.sample(0)
def test_a_type_checker_sees_the_methods_and_refuses_what_is_wrong(tmp_path: Path) -> None:
    stub = python_stub(load_protocol(str(ROOT / "examples" / "feetech.py")))
    (tmp_path / "servo.pyi").write_text(stub.replace("FeetechSts3215", "Servo"))
    code, settings = tmp_path / "drive.py", tmp_path / "mypy.ini"
    code.write_text(SEEN)
    settings.write_text(
        "[mypy]\nstrict = true\n[mypy-construct.*]\nignore_missing_imports = true\n"
    )
    options = ("--config-file", settings, "--cache-dir", tmp_path / "cache")
    mypy = [sys.executable, "-m", "mypy", *options, code]
    places = os.environ | {"MYPYPATH": str(tmp_path)}
    done = subprocess.run(mypy, cwd=ROOT, env=places, capture_output=True, text=True, check=False)

    found = [
        (int(line.split(":")[1]), line.rsplit("[", 1)[1].rstrip("]"))
        for line in done.stdout.splitlines()
        if ": error:" in line
    ]
    assert found == [
        (at, line.split("refused: ")[1])
        for at, line in enumerate(SEEN.splitlines(), 1)
        if "refused" in line
    ]
