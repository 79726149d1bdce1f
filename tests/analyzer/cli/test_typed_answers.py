"""`decode --from device` and `explain --from device` of answers of several bytes."""

from __future__ import annotations

import json

import pytest

from bilprov.analyzer import api
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.explain import explain_responses, requests_of
from tests.support import ROOT
from tests.support.commands import command

SILENT_END = "its end is uncertain: only silence marks it"
ROBOCLAW = str(ROOT / "examples" / "roboclaw.py")
# The grammar, an answer, its request, and what is shown without and with the request.
ANSWERS = [
    ("modbus-rtu", "110306 022B 0000 0064 C8BA", "1103006B0003 7687",
     "@17 answer values=555 0 100", "@17 answer values=555 0 100"),
    ("modbus-rtu", "118302 C134", "1103006B0003 7687",
     "@17 ILLEGAL_DATA_ADDRESS", "@17 ILLEGAL_DATA_ADDRESS"),
    ("modbus-rtu", "112B0E01830000000EA3", "112B0E0100B1B4",
     "@17 answer, 6 data bytes", "@17 answer, 6 data bytes"),
    ("stk500v1", "14 10", "30 20", f"OK {SILENT_END}", "OK"),
    ("stk500v1", "14 03 10", "41 81 20", f"OK, 1 data byte {SILENT_END}", "OK value=3"),
    ("stk500v1", "15", "30 20", "NOSYNC", "NOSYNC"),
    ("dynamixel1", "FFFF 01 02 00 FC", "FFFF 01 02 01 FB", "@1 OK", "@1 OK"),
    ("dynamixel1", "FFFF 01 04 00 18 05 DD", "FFFF 01 04 02 38 02 BE",
     "@1 OK, 2 data bytes", "@1 OK values=18 05"),
    ("dynamixel1", "FFFF 01 04 00 18 05 DE", "FFFF 01 04 02 38 02 BE",
     "@1 OK, 2 data bytes sum is de, right is dd", "@1 OK, 2 data bytes sum is de, right is dd"),
    (ROBOCLAW, "00 7C FE 55", "81 18 BB90", f"answer, 2 data bytes {SILENT_END}",
     "answer voltage=124"),
]  # fmt: skip


@pytest.mark.parametrize(("grammar", "answer", "asked", "alone", "known"), ANSWERS)
def test_an_answer_is_decoded_and_what_only_its_request_tells_is_left_open(
    grammar: str, answer: str, asked: str, alone: str, known: str
) -> None:
    words = ("decode", answer, "--from", "device", "--grammar", grammar)
    for more, expected in (((), alone), (("--request", asked), known)):
        done = command(*words, *more)
        assert done.returncode == 0, done.stderr
        (line,) = done.stdout.decode().splitlines()
        time, arrow, *rest = line.split()
        assert (time, arrow) == ("0.000000", "←")
        assert " ".join(rest).replace(" ", "").startswith(answer.replace(" ", "").lower())
        shown = " ".join(rest)[len(bytes.fromhex(answer).hex(" ")) + 1 :]
        assert shown.split(" the device answers")[0] == expected


def test_answers_are_paired_with_their_requests_and_how_long_they_took_is_not_known() -> None:
    words = ("decode", "14 10 14 03 10", "--from", "device", "--grammar", "stk500v1")
    done = command(*words, "--request", "30 20 41 81 20", "--format", "jsonl")
    first, second = map(json.loads, done.stdout.splitlines())
    assert (first["answers"], second["answers"]) == (0, 1)
    assert first["latency"] is second["latency"] is None
    assert (first["agrees"], second["fields"]) == (True, {"value": 3})
    filtered = command(*words, "--request", "30 20 41 81 20", "--filter", "value == 3")
    assert filtered.stdout.decode().split()[2:] == ["14", "03", "10", "OK", "value=3"]


@pytest.mark.parametrize(("grammar", "answer", "asked", "alone", "known"), ANSWERS)
def test_each_bit_of_an_answer_is_explained_once(
    grammar: str, answer: str, asked: str, alone: str, known: str
) -> None:
    protocol, data = load_protocol(grammar), bytes.fromhex(answer)
    for requests in ((), requests_of(protocol, bytes.fromhex(asked))):
        (one,) = explain_responses(protocol, data, requests).responses
        assert (one.frame, one.offset) == (data, 0)
        assert sum(len(group.bits) for group in one.groups) == 8 * len(data)
        shown = [range(group.byte, group.byte + group.size) for group in one.groups]
        assert [byte for span in shown for byte in span] == list(range(len(data)))
        assert (known if requests else alone).startswith(one.words)


def test_an_answer_is_explained_by_its_request() -> None:
    words = ("explain", "FFFF 01 04 20 18 05 BD", "--from", "device")
    words = (*words, "--grammar", str(ROOT / "examples" / "feetech.py"))
    alone = json.loads(command(*words, "--format", "json").stdout)["responses"][0]
    asked = ("--request", "FFFF 01 04 02 38 02 BE")
    known = json.loads(command(*words, *asked, "--format", "json").stdout)["responses"][0]
    assert (alone["name"], alone["fields"]) == ("OVERLOAD", {})
    assert known["fields"] == {"values": "1805", "present_position": 1304}
    named = command(*words, "--request", "read present_position address=1", "--format", "json")
    assert json.loads(named.stdout)["responses"][0] == known
    meanings = {row["name"]: row["meaning"] for row in alone["bits"]}
    assert meanings["data"] == "its request is needed to read it"
    drawn = command(*words, *asked).stdout.decode()
    assert "present_position  1304  steps" in drawn
    assert drawn.splitlines()[0].endswith("@1 OVERLOAD values=18 05 present_position=1304")


def test_python_explains_an_answer_by_its_request() -> None:
    protocol = load_protocol("stk500v1")
    (one,) = api.explain(b"\x14\x03\x10", "device", protocol, b"\x41\x81\x20").responses
    assert (one.words, [group.name for group in one.groups]) == (
        "OK value=3",
        ["insync", "value", "code"],
    )
    with pytest.raises(ValueError, match="41 81 is not answered"):
        api.explain(b"\x14\x10", "device", protocol, b"\x41\x81")


def test_what_is_no_answer_is_explained_as_that() -> None:
    (one,) = explain_responses(load_protocol("modbus-rtu"), bytes.fromhex("110306")).responses
    assert one.meaning == "the bytes are not an answer"
    assert [group.meaning for group in one.groups] == ["no answer"] * 3


def test_a_function_above_127_is_refused_with_the_bits_that_fit() -> None:
    sent = command("send", "sim", "11 ff 4d a0", "--grammar", "modbus-rtu")
    assert "11 7f 01 c0 35           @17 ILLEGAL_FUNCTION" in sent.stdout.decode(), sent.stderr
