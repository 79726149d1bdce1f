"""Texts of a grammar on a terminal: what does not print is refused, markup is shown as it is."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from bilprov.analyzer.transport.pty import open_pty
from tests.support.commands import command, process
from tests.support.grammars import mutated
from tests.support.robots import simulate
from tests.support.wires import running

# Every text that a grammar has, `~` where more can be put in.
PLACES = {
    "the name": {'NAME = "robot-car"': 'NAME = "car~"'},
    "the version": {'VERSION = "1.1"': 'VERSION = "1~"'},
    "the document": {'DOCUMENT = "': 'DOCUMENT = "~'},
    "a part of the header": {'"which instruction it is"': '"~which"'},
    "an instruction": {'1: "Speed"': '1: "Sp~eed"'},
    "an instruction's document": {'document="Hastighet"': 'document="~Hastighet"'},
    "an instruction's prose": {"Sets the speed with": "Sets ~ the speed with"},
    "a field": {'"speed" /': '"sp~eed" /', 'From("speed")': 'From("sp~eed")'},
    "a field's prose": {'"speed that the': '"~speed that the'},
    "the bits": {'bits="RGB"': 'bits="R~"'},
    "the reading": {'reading="R-led-upper-bits"': 'reading="R-~"'},
    "a response": {'"OK", Outcome': '"O~K", Outcome'},
    "a response's document": {'"Korrekt instruktion': '"~Korrekt instruktion'},
    "a response's prose": {'"correct instruction': '"~correct instruction'},
    "the header's clause": {'header="section 2"': 'header="~section 2"'},
    "the instructions' clause": {'instructions="section 3,': 'instructions="~section 3,'},
    "the responses' clause": {'responses="section 4,': 'responses="~section 4,'},
    "the safety's clause": {'safety="section 2"': 'safety="~section 2"'},
}


def with_texts(grammar_text: str, piece: str, places: dict[str, str]) -> str:
    """The grammar's text with a piece put into its texts at these places."""
    return mutated(grammar_text, {old: new.replace("~", piece) for old, new in places.items()})


def test_the_files_name_is_made_safe(grammar_text: str, tmp_path: Path) -> None:
    file = tmp_path / "\x1b[31m[red].py"
    file.write_text(grammar_text, encoding="utf-8")

    shown = command("--grammar", str(file), "spec", "show")

    assert shown.returncode == 0
    assert rb"grammar \x1b[31m[red].py" in shown.stdout
    assert b"\x1b" not in shown.stdout


@pytest.fixture(scope="module")
def marked(grammar_text: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The file of a grammar with markup in each of its texts."""
    places = {old: new for pairs in PLACES.values() for old, new in pairs.items()}
    places['bits="RGB"'] = 'bits="[/x]"'  # as many as the field has, at most
    file = tmp_path_factory.mktemp("marked") / "marked.py"
    file.write_text(with_texts(grammar_text, "[/x][red]", places), encoding="utf-8")
    return str(file)


SPEED = "Sp[/x][red]eed"
SHOWN = {
    "decode": (("decode", "11 05 81 09"), f"{SPEED} sp[/x][red]eed=5"),
    "jsonl": (("decode", "--format", "jsonl", "11 05"), f'"name":"{SPEED}"'),
    "explain": (("explain", "11 05"), "[/x][red]Hastighet"),
    "spec show": (("spec", "show"), "Sets [/x][red] the speed"),
    "spec readings": (("spec", "readings"), "R-unused-length"),
    "spec errata": (("spec", "errata"), "E1"),
    "spec emit c": (("spec", "emit", "c"), "/* [/x][red]Protokoll"),
    "encode": (("encode", SPEED, "sp[/x][red]eed=5"), "11 05"),
    "conform": (("conform", "sim", "--only", "valid/Sp*/[01]", "--verbose"), "[/x][red]"),
    "shell": (("send", "sim", "--yes"), f"{SPEED} sp[/x][red]eed=80"),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.waits] * (name == "shell")) for name in SHOWN],
)
@pytest.mark.parametrize("colour", [False, True], ids=["plain", "colour"])
def test_markup_is_shown_as_it_is(marked: str, name: str, colour: bool, tmp_path: Path) -> None:
    words, piece = SHOWN[name]
    if words[1] in ("readings", "errata"):  # those of the kit's own document alone
        own = tmp_path / "marked.py"
        own.write_text(
            Path(marked).read_text("utf-8").replace("[/x][red]Protokoll", "Protokoll"), "utf-8"
        )
        marked = str(own)
    variables = {"FORCE_COLOR": "1", "COLUMNS": "300"} if colour else {}

    done = command("--grammar", marked, *words, stdin=f"{SPEED} 80\n".encode(), **variables)

    assert done.returncode == 0, done.stderr
    assert piece in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", done.stdout.decode())


def test_the_bar_of_a_run_shows_markup_as_it_is(marked: str) -> None:
    only = ("--only", "valid/Sp*/[01]")

    done = command("--grammar", marked, "conform", "sim", *only, FORCE_COLOR="1", COLUMNS="200")

    assert done.returncode == 0, done.stderr
    assert f"valid/{SPEED}/" in done.stderr.decode()


@pytest.mark.waits
def test_send_shows_markup_as_it_is(marked: str) -> None:
    with simulate(grammar=marked) as robot:
        done = process("--grammar", marked, "send", robot.port, f"{SPEED} 80", "--yes")

    assert done.returncode == 0, done.stderr
    assert f"{SPEED} sp[/x][red]eed=80" in done.stdout.decode()


@pytest.mark.waits
def test_sniff_shows_markup_as_it_is(marked: str) -> None:
    with (
        open_pty() as host,
        running("--grammar", marked, "sniff", host.name, "--plain", "--count", "1") as sniffing,
    ):
        said = bytes.fromhex("11 05")
        code, out, err = sniffing.result_of(lambda: os.write(host.master, said))

    assert code == 0, err
    assert f"{SPEED} sp[/x][red]eed=5" in out.decode()


def test_the_help_says_that_a_grammar_is_run() -> None:
    helped = " ".join(command("--help").stdout.decode().split())

    assert "Runs the file as Python: name only files that you trust" in helped
    assert "a grammar inside a capture is only read" in helped
