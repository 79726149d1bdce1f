"""`simulate`, `send` and `sniff sim` with the grammars of other protocols than the car's."""

from __future__ import annotations

import json
import re

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.conformance.cli.shell.prompt import candidates
from tests.support.commands import Done, command


def sent(*items: str, grammar: str = "modbus-rtu", stdin: bytes = b"") -> Done:
    return command("--grammar", grammar, "send", "sim", *items, stdin=stdin)


def lines(done: Done) -> list[str]:
    """The lines without their times and latencies."""
    text = re.sub(r" +\d+\.\d+ ms", "", done.stdout.decode())
    return [re.sub(r"^ *[\d.]+ ", "", line).rstrip() for line in text.splitlines()]


def test_what_is_sent_and_answered_is_shown_with_its_fields() -> None:
    done = sent(
        "WriteSingleRegister address=1 register=4 value=9",
        "ReadHoldingRegisters address=1 start=3 quantity=2",
    )

    assert done.returncode == 0, done.stderr
    assert lines(done) == [
        "→ 01 06 00 04 00 09 08 0d  @1 WriteSingleRegister register=4 value=9",
        "← 01 06 00 04 00 09 08 0d  @1 answer register=4 value=9",
        "→ 01 03 00 03 00 02 34 0b  @1 ReadHoldingRegisters start=3 quantity=2",
        "← 01 03 04 00 00 00 09 3a 35  @1 answer values=0 9",
    ]


def test_what_is_not_to_be_answered_is_not_missed() -> None:
    done = sent("WriteSingleCoil address=0 coil=1 value=on", "01 03 00 00 00 01 84 0b")

    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    assert [line[0] for line in lines(done)] == ["→", "→"]
    assert "crc is 84 0b, right is 84 0a" in lines(done)[1]


@pytest.mark.parametrize(
    ("expected", "code"),
    [("answer,ILLEGAL_DATA_VALUE", 0), ("answer,3", 0), ("answer,none", 1), ("4,3", 1)],
)
def test_expectations_name_answers_and_errors(expected: str, code: int) -> None:
    items = "ReadCoils address=1 start=0 quantity=3", "01 03 00 00 00 00 45 ca"
    assert sent(*items, "--expect", expected).returncode == code


def test_bytes_that_begin_no_frame_are_no_instruction() -> None:
    done = sent("Ping address=1", "55 aa", grammar="dynamixel1")

    assert lines(done)[-1].split() == ["→", "55", "aa", "garbage", "no", "frame", "begins", "so"]
    assert done.returncode == 0, done.stderr


def test_lines_that_are_typed_are_sent() -> None:
    done = sent(
        grammar="stk500v1",
        stdin=b"GetSync; LoadAddress 16\nstate\nProgPage size=2 memory=flash content=0102; stop\n",
    )

    assert done.returncode == 2
    assert b"'stop' is not hex" in done.stderr
    assert lines(done) == [
        "→ 30 20        GetSync",
        "← 14 10        OK",
        "→ 55 10 00 20  LoadAddress address=16",
        "← 14 10        OK",
        "predicted: nothing, the grammar has no STATE",
    ]


def test_nothing_looks_at_a_simulated_device_that_is_no_car() -> None:
    done = sent(stdin=b"look\n")
    asked = sent("ReportServerId address=1", "--probe", "sim")

    assert done.stdout == b"nothing sees the Modbus device: begin with --probe\n"
    assert asked.returncode == 2
    assert b"the probe of sim sees a car, and modbus-rtu has none" in asked.stderr


def test_help_of_the_shell_names_the_address() -> None:
    done = sent(stdin=b"help\n")

    assert b"address=1..247" in done.stdout
    assert b"value=off|on" in done.stdout
    assert b"home" not in done.stdout


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("WriteSingleC", ["WriteSingleCoil"]),
        ("WriteSingleCoil ", ["coil=", "value=", "address="]),
        ("WriteSingleCoil value=", ["off", "on"]),
        ("WriteSingleCoil address=", ["1", "247"]),
        ("WriteMultipleCoils coils=", []),
    ],
)
def test_fields_names_and_the_address_are_completed(typed: str, offered: list[str]) -> None:
    found = candidates(load_protocol("modbus-rtu"), {}, typed)
    assert [one.text for one in found] == offered


@pytest.mark.parametrize("option", [["--fault", "always-0"], ["--list-variants"]])
def test_the_simulator_of_another_protocol_has_no_faults(option: list[str]) -> None:
    done = command("--grammar", "modbus-rtu", "simulate", *option)

    assert done.returncode == 2
    assert f"{option[0]} is for the robot car and its family".encode() in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("grammar", ["modbus-rtu", "stk500v1", "dynamixel1"])
def test_simulated_traffic_is_answered_as_it_should_be(grammar: str) -> None:
    done = command("--grammar", grammar, "sniff", "sim", "--count", "4", "--format", "jsonl")

    records = [json.loads(line) for line in done.stdout.splitlines()]
    frames = [one for one in records if one["kind"] in ("instruction", "response")]
    assert len(frames) == 4
    assert all(one["agrees"] for one in frames if one["kind"] == "response")
