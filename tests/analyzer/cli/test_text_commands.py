"""Text commands, called as users and scripts call them."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from bilprov.analyzer.cli.typed_input import bytes_from_hex
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.port_list import drawn, unseen
from bilprov.analyzer.transport.machine import Process
from bilprov.analyzer.transport.ports import PortInfo
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.readings import ERRATA, READINGS
from tests.support.commands import command, process
from tests.support.drawn_grammars import drawn as drawn_grammar

PROTOCOL = load_protocol()

HORN = """
    9: "Horn"
    / Instruction("tone" / Ranged(Byte, 0, 3) * "which tone", document="Tuta")
    * "Sounds the horn.",
}
"""


def text(*arguments: str) -> str:
    result = command(*arguments)
    assert (result.returncode, result.stderr) == (0, b"")
    assert b"\x1b" not in result.stdout
    return result.stdout.decode()


def sentence(*arguments: str) -> str:
    result = command(*arguments)
    assert (result.returncode, result.stdout) == (2, b"")
    (line,) = result.stderr.decode().splitlines()
    assert line.startswith("bilprov: ")
    return line.removeprefix("bilprov: ")


@pytest.fixture
def horn(tmp_path: Path) -> str:
    """Another grammar: the kit's with one literal entry added."""
    head, tail = PROTOCOL.source.split("\n}\n", 1)
    file = tmp_path / "horn.py"
    file.write_text(f"{head}{HORN}{tail}", encoding="utf-8")
    return str(file)


# encode


@pytest.mark.parametrize(
    ("words", "frame"),
    [
        ("LED rgb=5", "81 05"),
        ("led RGB=0b101", "81 05"),
        ("Speed 127", "11 7f"),
        ("Speed speed=0x7F", "11 7f"),
        ("Speed 007", "11 07"),
        ("Stop", "00"),
    ],
)
def test_encode_prints_the_frame_in_hex(words: str, frame: str) -> None:
    assert text("encode", *words.split()) == f"{frame}\n"


def test_encode_raw_writes_the_bytes_themselves() -> None:
    assert command("encode", "--raw", "Speed", "0x0a").stdout == b"\x11\x0a"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("Sped 1", "there is no instruction 'Sped', did you mean Speed?"),
        ("Fly", "there is no instruction 'Fly'; there are Stop, Speed"),
        ("LED", "LED needs rgb=0..7"),
        ("LED rgb=8", "LED.rgb is 8, allowed are 0 to 7"),
        ("LED rgb=-1", "LED.rgb is -1, allowed are 0 to 7"),
        ("Speed -1", "Speed.speed is -1, allowed are 0 to 255"),
        ("LED rbg=1", "LED has no field 'rbg', did you mean rgb?"),
        ("LED rgb=1 rgb=2", "LED.rgb is given twice"),
        ("LED 1 rgb=2", "LED.rgb is given twice"),
        ("LED rgb=red", "LED.rgb is 'red', which is not a number; allowed are 0 to 7"),
        ("LED rgb=", "which is not a number"),
        ("Stop 1", "Stop takes no values; got 1"),
        ("LED --rwa", "no such option '--rwa', did you mean --raw?"),
        ("LED rgb=" + "9" * 5000, "LED.rgb is"),
    ],
)
def test_encode_says_what_is_wrong_in_one_sentence(words: str, part: str) -> None:
    assert part in sentence("encode", *words.split())


# explain


@pytest.mark.parametrize(
    "written", ["81 05", "8105", "0x81 0x05", "0x81,0x05", "81:05", "81 5", r"\x81 \x05", "81-05"]
)
def test_hex_is_taken_as_people_write_it(written: str) -> None:
    assert bytes_from_hex(written) == b"\x81\x05"


@pytest.mark.parametrize("written", ["", " ", "zz", "0x", "81 0g", "810", "٣٣", "81=05"])
def test_hex_that_is_not_hex_is_one_sentence(written: str) -> None:
    assert sentence("explain", written)


def test_explain_draws_bits_names_and_reasons() -> None:
    shown = text("explain", "81", "09")
    for part in (
        "81 09  LED rgb=9",
        "00001 0 0 1",
        "answer   BAD_DATA, code 02",
        "why      LED.rgb is 9, allowed are 0 to 7",
        "R-led-upper-bits",
        "nearest  81 01  LED rgb=1 (B)",
    ):
        assert part in shown


@pytest.mark.waits
def test_explain_draws_with_ascii_where_there_is_nothing_else() -> None:
    shown = process("explain", "81", "09", env={"PYTHONIOENCODING": "ascii"}).stdout.decode()

    assert "====" in shown
    assert "\\u" not in shown


@pytest.mark.parametrize("items", [("91", "02"), ("81", "09"), ("40",)])
def test_explain_shows_each_choice_of_a_reading_on_a_line_of_its_own(items: tuple[str]) -> None:
    shown = text("explain", *items)

    assert "\\" not in shown
    lines = [line.strip() for line in shown.splitlines()]
    assert any(line.startswith("our default: ") for line in lines)
    assert any(line.startswith("otherwise: ") for line in lines)


def test_explain_from_the_device_explains_responses() -> None:
    shown = text("explain", "--from", "device", "00", "05")
    assert "correct instruction received" in shown
    assert "a device that sends one does not conform" in shown


def test_explain_as_json_says_the_same() -> None:
    told = json.loads(text("explain", "--format", "json", "91 02"))
    (frame,) = told["frames"]
    assert frame["judgement"] == "BAD_HEADER"
    assert frame["nearest"]["hex"] == "81 02"
    assert [erratum["id"] for erratum in frame["errata"]] == ["E5"]
    assert "".join(group["bits"] for group in frame["bits"]) == "1001000100000010"
    (code,) = json.loads(text("explain", "--format", "json", "--from", "device", "2"))["responses"]
    assert code["name"] == "BAD_DATA"


# spec


def test_spec_show_tells_all_of_the_protocol() -> None:
    shown = text("spec", "show")
    for spec in PROTOCOL.instructions:
        assert spec.prose in shown
    for response in PROTOCOL.responses:
        assert response.document in shown
    assert PROTOCOL.sha256 in shown
    told = json.loads(text("spec", "show", "--format", "json"))
    assert [spec["id"] for spec in told["instructions"]] == list(PROTOCOL.by_id)
    assert [response["code"] for response in told["responses"]] == list(PROTOCOL.codes)


def test_spec_readings_tells_each_with_its_default_and_the_others() -> None:
    shown = text("spec", "readings")
    told = json.loads(text("spec", "readings", "--format", "json"))
    assert [reading["id"] for reading in told] == [reading.id for reading in READINGS]
    for reading in READINGS:
        assert reading.id in shown
        assert reading.default in shown


def test_spec_readings_tells_one_by_its_id() -> None:
    shown = text("spec", "readings", "r-led-id")
    assert "R-led-id" in shown
    assert "R-line" not in shown
    assert "did you mean R-led-id?" in sentence("spec", "readings", "R-lid-id")


def test_spec_errata_finds_two_by_itself_and_lists_the_others() -> None:
    found, others = text("spec", "errata").split("Not found by running the examples")
    assert [name for name in ("E1", "E2", "E3", "E4", "E5", "E6") if name in found] == ["E3", "E5"]
    for erratum in ERRATA:
        assert (erratum.id in others) == (erratum.id not in ("E3", "E5"))
    told = json.loads(text("spec", "errata", "--format", "json"))
    assert [finding["id"] for finding in told["found"]] == ["E3", "E5"]
    assert len(told["all"]) == len(ERRATA)


@pytest.mark.parametrize(("name", "what"), [("errata", "examples"), ("readings", "readings")])
def test_the_documents_examples_and_readings_are_of_no_other_document(
    tmp_path: Path, name: str, what: str
) -> None:
    other = tmp_path / "other.py"
    other.write_text(drawn_grammar(1).text, encoding="utf-8")
    assert f"this grammar has no {what}" in sentence("--grammar", str(other), "spec", name)


# another grammar


def test_another_grammar_is_followed_everywhere(horn: str) -> None:
    other = ("--grammar", horn)
    assert text(*other, "encode", "Horn", "tone=3") == "91 03\n"
    assert "Horn.tone is 4, allowed are 0 to 3" in sentence(*other, "encode", "Horn", "4")
    assert "which tone, 0 to 3" in text(*other, "explain", "91 02")
    assert "E5" not in text(*other, "explain", "91 02")
    assert "BAD_DATA" in text(*other, "explain", "91 04")
    assert "Sounds the horn." in text(*other, "spec", "show")
    assert "unused: 10," in text(*other, "spec", "show")
    found = json.loads(text(*other, "spec", "errata", "--format", "json"))["found"]
    assert [finding["id"] for finding in found] == ["E3"]


# ports, completion


def test_ports_lists_or_says_what_to_do() -> None:
    assert command("ports").stdout.strip()
    for port in json.loads(command("ports", "--format", "json").stdout):
        assert {"path", "description", "hardware_id", "likely", "holders", "unseen"} <= set(port)


PORTS = [
    PortInfo("/dev/ttyS0", "", "PNP0501", likely=False, driver="serial"),
    PortInfo(
        "/dev/ttyUSB0",
        "FT232R \x1b[31mUSB UART",
        "USB VID:PID=0403:6001",
        likely=True,
        usb="0403:6001",
        serial_number="A10K3XYZ",
        by_id="/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A10K3XYZ-if00-port0",
        driver="ftdi_sio",
        latency_ms=16,
        holders=(Process(4242, "minicom", "minicom -D /dev/ttyUSB0"),),
        unseen=3,
    ),
]


def test_ports_fit_80_columns_and_hold_every_fact() -> None:
    console = Console(width=80, file=io.StringIO(), color_system=None)
    for part in drawn(PORTS):
        console.print(part)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    words = ("/dev/ttyS0", "*", "0403:6001", "ftdi_sio", "16 ms", "minicom (pid 4242)", "A10K3XYZ")
    for word in (*words, "usb-FTDI_FT232R_USB_UART_A10K3XYZ-if00-port0"):
        assert word in shown
    assert "\x1b" not in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


def test_ports_say_whose_processes_they_could_not_look_into() -> None:
    assert unseen(PORTS).startswith("3 processes of other users could not be examined")
    assert unseen(PORTS[:1]) == ""


@pytest.mark.waits  # for bash, to tell its version
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_for_the_shell(shell: str) -> None:
    assert "_BILPROV_COMPLETE" in text("completion", shell)


# info


def capture(path: Path, **metadata: str) -> None:
    with CaptureWriter(path, start_wall=1_700_000_000 * 10**9, metadata=metadata, version="1") as w:
        w.chunk(Chunk(0, "host", b"\x81\x05"))
        w.chunk(Chunk(1_500_000_000, "device", b"\x00"))


def test_info_tells_what_a_capture_holds(tmp_path: Path) -> None:
    file = tmp_path / "c.mcap"
    capture(file, grammar_sha256=PROTOCOL.sha256, host="/dev/ttyUSB0")
    shown = text("capture", "info", str(file))
    for part in ("2023-11-14T22:13:20", "1.500 s", "the grammar in use", "/dev/ttyUSB0", "2 bytes"):
        assert part in shown
    told = json.loads(text("capture", "info", "--format", "json", str(file)))
    assert told["bytes"] == {"host": 2, "device": 1}
    assert told["same_grammar"] is True
    assert told["unfinished"] is False


def test_info_as_json_says_when_where_and_by_which_kit_it_was_recorded(tmp_path: Path) -> None:
    file, part = tmp_path / "c.mcap", tmp_path / "part.mcap"
    capture(file, machine="rover", version="0.0.9")
    told = json.loads(text("capture", "info", "--json", str(file)))
    assert told == json.loads(text("capture", "info", "--format", "json", str(file)))
    assert (told["start"], told["end"]) == (
        "2023-11-14T22:13:20.000000+00:00",
        "2023-11-14T22:13:21.500000+00:00",
    )
    assert (told["zero"], told["duration"]) == (told["start"], 1.5)
    assert (told["host"], told["kit"]) == ("rover", "0.0.9")
    assert command("capture", "cut", str(file), str(part), "--start", "1").returncode == 0
    told = json.loads(text("capture", "info", "--json", str(part)))
    assert (told["start"][17:], told["zero"][17:]) == ("21.000000+00:00", "20.000000+00:00")
    assert told["duration"] == 0.5
    shown = text("capture", "info", str(part))
    for said in ("rover", "bilprov 0.0.9", "cut c.mcap --start 1", "times count from"):
        assert said in shown


def test_info_says_when_the_grammar_is_another(tmp_path: Path, horn: str) -> None:
    file = tmp_path / "c.mcap"
    capture(file, grammar_sha256=PROTOCOL.sha256)
    assert "not the grammar in use" in text("--grammar", horn, "capture", "info", str(file))


def test_info_reads_an_unfinished_file_and_says_so(tmp_path: Path) -> None:
    whole, cut = tmp_path / "c.mcap", tmp_path / "cut.mcap"
    capture(whole)
    cut.write_bytes(whole.read_bytes()[:-100])
    assert "not finished" in text("capture", "info", str(cut))


def test_info_makes_foreign_text_harmless(tmp_path: Path) -> None:
    file = tmp_path / "c.mcap"
    capture(file, host="\x1b[31m[/red]\u202eevil", **{"k\x07ey": "x"})
    shown = text("capture", "info", str(file))
    assert all(line.isprintable() for line in shown.splitlines())
    assert "[/red]" in shown


@pytest.mark.parametrize("content", [b"", b"hello, this is text", b"\x89MCAP0\r\n"])
def test_info_refuses_what_is_no_capture(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "c.mcap"
    file.write_bytes(content)
    assert "c.mcap" in sentence("capture", "info", str(file))
