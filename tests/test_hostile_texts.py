"""Hostile texts of captures, settings and grammars on every surface: each is shown as text.

The tables pair the sources of foreign text with the surfaces that show them; there is one check for
each kind of surface. Of all other sources `test_doors.py` shows that only safe texts come in.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import dissector_program
from bilprov.captures.schemas import Chunk, Line, Log, Time
from bilprov.captures.text import escape_controls, escape_json
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.learning.drawing import dot_text
from bilprov.conformance.learning.learner import Output
from bilprov.conformance.machines.wp_method import Mealy
from bilprov.spec.emit.c import c_header
from bilprov.spec.emit.python import python_stub
from bilprov.spec.emit.wireshark import lua_dissector
from bilprov.spec.protocol import Protocol, load
from tests.support.commands import command
from tests.support.grammars import PLACES, with_texts
from tests.support.surfaces import (
    HOSTILE,
    NUL,
    TAME,
    c_lines,
    csv_cells,
    html_elements,
    lua_tokens,
    seen,
)

SECOND = 1_000_000_000
MOST = 100_000  # bytes of what is shown for people, however long a text is

Check = Callable[[bytes], object]
"""What must hold of an output with a hostile text."""


EVERY = HOSTILE | {"nul": NUL, "long": "x\x1b[2J" * 10_000}


def test_json_that_prints_has_the_same_value() -> None:
    value = [*EVERY.values()]
    text = json.dumps(value, ensure_ascii=False, indent=1).encode()

    assert json.loads(escape_json(text)) == value
    seen(escape_json(text))


# -- captures --------------------------------------------------------------------------------------

KEYS = (
    *("grammar_name", "grammar_version", "kit", "machine", "version", "line", "history", "host"),
    *("port_host", "truncation_timeout_ms"),
)
# What an opened capture gives prints (see tests/captures/test_door.py). These would take markup, or
# a formula, for what it is.
CAPTURE_SURFACES: dict[str, tuple[str, Check]] = {
    "info": ("capture info {file}", seen),
    "stats": ("stats {file}", seen),
    "replay, lines": ("replay {file} --rate 0", seen),
    "replay, csv": ("replay {file} --rate 0 --format csv", csv_cells),
    "export, csv": ("export {file} --format csv -o -", csv_cells),
    "plot": ("plot {file} --html -", html_elements),
    "compare": ("capture diff {file} {file}", seen),
    "join": ("capture join {file} {other} -o {new}", seen),
    "doctor": ("capture check {file}", seen),
    "recheck": ("recheck {file}", seen),
}


def a_capture(path: Path, text: str, start: int = 1_700_000_000 * SECOND) -> Path:
    """A capture of a drive in which every text is this one."""
    about = dict.fromkeys([*KEYS, text[:60]], text)
    with CaptureWriter(path, start_wall=start, metadata=about, version="1") as out:
        for at in range(5):
            out.chunk(Chunk(at * SECOND, "host", b"\x11\x05"))
            out.chunk(Chunk(at * SECOND + 1000, "device", b"\x00\x77"))
        short = text.encode(errors="replace").decode()[:1000]  # as JSON is, which these become
        out.write(Line(5 * SECOND, short, "", short), 5 * SECOND)
        out.write(Line(5 * SECOND, "unplugged", "host", short), 5 * SECOND)
        out.write(Log(Time(0, 0), 4, short, short), 5 * SECOND)
        out.attach(short, short, b"x", 6 * SECOND)
    return path


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Path]]:
    """Two captures with a hostile text, by its name, or with a tame one."""
    folder = tmp_path_factory.mktemp("captures")

    @cache
    def made(name: str) -> dict[str, Path]:
        text = EVERY.get(name, TAME)
        return {
            "file": a_capture(folder / f"{name}.mcap", text),
            "other": a_capture(folder / f"{name}-2.mcap", text, 1_700_000_100 * SECOND),
        }

    return made


@pytest.mark.sample(8)
@pytest.mark.parametrize("surface", CAPTURE_SURFACES)
@pytest.mark.parametrize("name", EVERY)
def test_a_captures_texts_do_nothing(
    name: str, surface: str, captures: Callable[[str], dict[str, Path]], tmp_path: Path
) -> None:
    words, check = CAPTURE_SURFACES[surface]
    result, tame = (
        command(*words.format(**captures(which), new=tmp_path / f"{which}.mcap").split())
        for which in (name, TAME)
    )

    assert result.returncode == tame.returncode, result.stderr
    assert b"Traceback" not in seen(result.stderr).encode()
    shape = check(result.stdout)
    assert check is not html_elements or shape == check(tame.stdout)
    assert check is not seen or len(result.stdout + result.stderr) < MOST


# -- grammars --------------------------------------------------------------------------------------

# What does not print is refused in every text of a grammar: see test_doors.py.
IN_GRAMMARS = {
    name: escape_controls(text).replace("\\", "\\\\").replace('"', '\\"')
    for name, text in HOSTILE.items()
    if text.isprintable() or name == "markdown"
}


@cache
def a_grammar(grammar_text: str, piece: str) -> str:
    """The text of the grammar with a piece in each of its texts, as long as these may be."""
    places = {old: new for pairs in PLACES.values() for old, new in pairs.items()}
    places['bits="RGB"'] = 'bits="*/]"'
    return with_texts(grammar_text, piece, places)


@pytest.fixture(scope="module", params=list(IN_GRAMMARS))
def grammars(request: pytest.FixtureRequest, grammar_text: str) -> tuple[Protocol, Protocol]:
    """A grammar with a hostile text in each of its texts, and the same one with a tame text."""
    piece = IN_GRAMMARS[request.param][:40].rstrip("\\")
    return load(a_grammar(grammar_text, piece)), load(a_grammar(grammar_text, "x"))


def test_a_grammars_texts_stay_in_the_comments_of_c(
    grammars: tuple[Protocol, Protocol], tmp_path: Path
) -> None:
    evil, tame = (c_lines(c_header(one)) for one in grammars)

    assert [line[:1] + line[2:] for line in evil] == [line[:1] + line[2:] for line in tame]
    assert all(re.fullmatch(r"[A-Z0-9_]+", line[1]) for line in evil if line[1:])
    if compiler := shutil.which("gcc"):
        file = tmp_path / "a.c"
        file.write_text(f"{c_header(grammars[0])}int a;\n", encoding="utf-8")
        flags = ("-std=c90", "-pedantic-errors", "-Wall", "-Werror", "-Wno-trigraphs")
        done = subprocess.run(
            [compiler, *flags, "-fsyntax-only", str(file)], capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_a_grammars_texts_stay_in_the_strings_of_lua(grammars: tuple[Protocol, Protocol]) -> None:
    evil, tame = (lua_tokens(lua_dissector(one, 16, dissector_program())) for one in grammars)

    assert evil == tame


def test_a_grammars_texts_stay_in_the_docstrings_of_a_stub(
    grammars: tuple[Protocol, Protocol],
) -> None:
    kinds = [
        [type(node).__name__ for node in ast.walk(ast.parse(python_stub(one)))] for one in grammars
    ]

    assert kinds[0] == kinds[1]


def test_names_and_devices_stay_in_the_labels_of_a_picture(protocol: Protocol) -> None:
    outputs = tuple(Output((at,)) for at in range(len(HOSTILE)))
    machine = Mealy(((0,) * len(HOSTILE),), (outputs,))

    def drawn(names: list[str], title: str) -> str:
        return dot_text(protocol, machine, names, title, {(0, 0)})

    evil = [escape_controls(text) for text in HOSTILE.values()]
    pair = drawn(evil, "".join(evil)), drawn([TAME] * len(evil), TAME)

    outside = [re.sub(r'"(\\.|[^"\\])*"', '""', text) for text in pair]
    assert outside[0] == outside[1]


# Markup of rich, which is shown as it is.
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
    "name", [pytest.param(name, marks=[pytest.mark.waits] * (name == "shell")) for name in SHOWN]
)
def test_markup_of_a_grammar_is_shown_as_it_is(
    name: str, grammar_text: str, tmp_path: Path
) -> None:
    words, piece = SHOWN[name]
    places = {old: new for pairs in PLACES.values() for old, new in pairs.items()}
    places['bits="RGB"'] = 'bits="[/x]"'  # as many as the field has, at most
    if words[1] in ("readings", "errata"):  # those of the kit's own document alone
        del places['DOCUMENT = "']
    file = tmp_path / "\x1b[31m[red].py"
    file.write_text(with_texts(grammar_text, "[/x][red]", places), encoding="utf-8")

    for colour in ({}, {"FORCE_COLOR": "1", "COLUMNS": "300"}):
        done = command(*("--grammar", str(file), *words), stdin=f"{SPEED} 80\n".encode(), **colour)
        assert done.returncode == 0, done.stderr
        assert piece in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", done.stdout.decode())
