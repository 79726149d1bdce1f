"""The stub beside `robot.py`: a type checker sees the instructions of the grammar."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.emit.python import RENEW, method_names, parameter_names, python_stub, snake_case
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT

STUB = ROOT / "analyzer" / "client" / "robot.pyi"


def test_the_committed_stub_is_what_the_grammar_gives(protocol: Protocol) -> None:
    written = STUB.read_text(encoding="utf-8")

    assert written == python_stub(protocol), f"the grammar has changed: run `{RENEW}`"


def signatures(stub: str) -> dict[str, str]:
    """The methods of the stub with their parameters and what they return."""
    return {
        node.name: f"{ast.unparse(node.args)} -> {ast.unparse(node.returns)}"
        for node in ast.walk(ast.parse(stub))
        if isinstance(node, ast.FunctionDef) and node.returns
    }


def require_left_alone(stub: str, folder: Path) -> None:
    """Neither ruff's formatter nor its rules find anything to change in the stub."""
    file = folder / "device.pyi"
    file.write_text(stub, encoding="utf-8")
    style = ["--isolated", "--line-length", "100", file]
    for words in (["format", "--diff"], ["check", "--select", "E,F,W"]):
        command = [sys.executable, "-m", "ruff", *words, *style]
        done = subprocess.run(command, capture_output=True)
        assert done.returncode == 0, done.stdout


# What the stub of a grammar has of a method.
TYPED = [
    ("modbus-rtu", "read_coils", "self, start: int, quantity: int, ADDRESS -> bytes"),
    ("modbus-rtu", "write_single_coil",
     "self, coil: int, value: int | str, ADDRESS -> WriteSingleCoilAnswer"),
    ("stk500v1", "prog_page", "self, size: int, memory: int | str, content: bytes | str -> None"),
    ("stk500v1", "set_device_ext",
     "self, eeprom_page_size: int, pagel: int, bs2: int, reset_disable: int -> None"),
    ("dynamixel1", "read", "self, register: int, size: int, ADDRESS -> bytes"),
]  # fmt: skip


@pytest.mark.parametrize(("grammar", "method", "typed"), TYPED)
def test_answers_with_data_have_types(
    grammar: str, method: str, typed: str, tmp_path: Path
) -> None:
    protocol = load_protocol(grammar)
    stub = python_stub(protocol)

    assert signatures(stub)[method] == typed.replace("ADDRESS", "*, address: int | None=None")
    assert len(signatures(stub)) == len(protocol.instructions)
    require_left_alone(stub, tmp_path)


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
