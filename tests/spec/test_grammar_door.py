"""The door of grammars: each wrong or hostile one ends in a short sentence, in bounded work.

A grammar inside a capture must first hold nothing but declarations; one that the user names is
loaded without that. What random values in a grammar do is a property in `tests/test_doors.py`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.safe_grammar import LONGEST, NotDeclared, require_declarations
from tests.support.commands import process
from tests.support.framed_traffic import FRAMED
from tests.support.grammars import mutated

SPEED = '"speed" / Ranged(Byte, 0, 255)'
ID, LENGTH = '"id" / BitsInteger(4)', '"length" / BitsInteger(4)'
HUNDRED_TWENTY_SEVEN = ", ".join(f'"f{n}" / Ranged(Byte, 0, 255)' for n in range(127))


def field(declaration: str) -> dict[str, str]:
    """What changes the field of Speed."""
    return {SPEED: declaration}


def test_pythons_own_remarks_about_a_grammar_are_not_shown(
    grammar_text: str, recwarn: pytest.WarningsRecorder
) -> None:
    with pytest.raises(NotDeclared, match=r"there is 1\('\\d'\) in line"):
        require_declarations(f"{grammar_text}\nX = 1('\\d')\n")
    load(f'{grammar_text}\nX = "\\d"\n')
    assert not recwarn.list


# Declarations only: a stranger's grammar can reach nothing else.

WORDS = (
    "from construct import BitsInteger, BitStruct, Byte, Struct, Switch, this\n"
    "from spec.fields import Answer, Answers, Instruction, Outcome, Ranged, Sets\n"
)
REFUSED = [
    *("import os", "from os import system", "from construct import Computed"),
    *("from construct import Byte as Int", "from .fields import Sets"),
    *("from bilprov.spec.fields import *", "X = eval('1')", "X = Sets()()", "X = Byte.parse(b'')"),
    *("X = this.__class__", "X = this._root", "X = 'a'.join", "X = Sets.values"),
    *("X = Outcome.VALID.value", "X = [a for a in 'b']", "def f(): pass", "class A: pass"),
    *("X = lambda: 1", "X = f'{1}'", "X = {}[0]", "Sets()", "X = Sets(**{'a': 1})", "X = {**{}}"),
    *("X = Sets(*[1])", "X = Sets(*this)", "X = Struct(*Byte)", "W = (99,)\nX = BitsInteger(*W)"),
    *(
        "W = ((99,),)\nX = BitsInteger(*W)",
        "X = this._._root",
        "X = 1 << 62",
        "X = 9 ** 9",
        "X = 'a' * 9999",
        "N = 9999\nX = N * 'a'",
    ),
    *("X = (9999 * 'a') * 'b'", "X = 99999999999", "X = this(1)", "X = BitsInteger(65)"),
    *("N = 99999\nM = N\nX = BitsInteger(M)", "X = b'1' * 9", "Byte = 1", "__builtins__ = 1"),
    *("X = 1\nX = 2", "X = Y", "X = Y = 1", "if 1: pass", "X = (", "X = '\0'"),
    f"X = {'[' * 50}{']' * 50}",  # deep enough to be refused, not too deep for Python
    *(f"X = {'(' * 5000}{')' * 5000}", f"X = {'-' * 5000}1", "#" * (LONGEST + 1)),
]


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:30])
def test_what_is_no_declaration_is_refused(text: str) -> None:
    with pytest.raises(NotDeclared):
        require_declarations(WORDS + text)


def test_fields_that_several_instructions_share_and_the_struct_around_are_declared() -> None:
    shared = 'SHARED = ("a" / Byte, "b" / Byte)\nMORE = (*SHARED, "c" / Byte)\n'
    require_declarations(f"{WORDS}{shared}X = Struct(*MORE)\nY = Sets(*SHARED)\nZ = this._.length")


def test_zeros_are_declared() -> None:
    require_declarations(WORDS + "X = bytes(5)")
    for text in ("X = bytes(65)", "X = bytes(-1)", "X = bytes(5, 'a')", "bytes = 1\nX = bytes(5)"):
        with pytest.raises(NotDeclared):
            require_declarations(WORDS + text)


def test_the_kits_own_grammar_the_horns_and_the_longest_text_declare(
    grammar_text: str, horn_text: str
) -> None:
    for text in (grammar_text, horn_text, "#" * LONGEST):
        require_declarations(text)


# What would take memory or time without end.


def chained(first: str, step: str, count: int) -> str:
    """Assignments of X0 to X`count`, each made of the one before, which stands for `~`."""
    lines = [f"X{n} = {step.replace('~', f'X{n - 1}')}" for n in range(1, count + 1)]
    return "\n".join([f"X0 = {first}", *lines, ""])


FIELD = field('"speed" / Ranged(X60, 0, 255)')
NAMES = "".join(f'Y{n} = X9000 * "a"\n' for n in range(9000))

# What stands in front of the kit's own grammar, and what is changed in that to use it.
BOMBS: dict[str, tuple[str, dict[str, str]]] = {
    "tuples of tuples": (chained("0", "(~, ~)", 60), {"speed=0": "speed=X60"}),
    "dicts of dicts": (chained("0", "{1: ~, 2: ~}", 60), {"speed=0": "speed=X60"}),
    "starred tuples": (chained("(0,)", "(*~, *~)", 60), {"speed=0": "speed=X60"}),
    "constructs of constructs": (chained("Byte", 'Struct("a" / ~, "b" / ~)', 60), FIELD),
    "bits of bits": (chained("BitsInteger(1)", 'BitStruct("a" / ~, "b" / ~)', 60), {}),
    "cases of cases": (chained("Byte", "Switch(this.a, {1: ~, 2: ~})", 60), FIELD),
    "deep ranges": (chained("Byte", "Ranged(~, 0, 255)", 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "deep tuples": (chained("0", "(~,)", 3000), {"speed=0": "speed=X3000"}),
    "prose on prose": (chained("Byte", '~ * "a"', 3000), {"Byte, 0, 7": "X3000, 0, 7"}),
    "names of names": (chained("Byte", "~", 9000) + NAMES, {}),
    "a deep path": (f"X = this{'.a' * 60_000}\n", {}),
    "deep brackets": (f"X = {'[' * 100_000}\n", {}),
    "deep calls": (f"X = {'Struct(' * 150}\n", {}),
    "a repeated text": ('N = this(4294967296)\nX = N * "aaaaaaaaaaaaaaaa"\n', {}),
    "a hidden width": ("X = BitsInteger(this(4294967296))\n", {ID: '"id" / X'}),
    "many numbers": (f"X = [{'1,' * 100_000}]\n", {}),
    "a very long text": (f'X = "{"a" * 3_000_000}"\n', {}),
    "a name of pages": (f'X = "{"a" * 200_000}"\n', {'NAME = "': 'NAME = X\nY = "'}),
    "many fields": (
        "",
        {ID: '"id" / BitsInteger(1)', LENGTH: '"length" / BitsInteger(7)'}
        | field(HUNDRED_TWENTY_SEVEN),
    ),
}

# In 1 GiB of memory and 30 s of computing, for all of them.
RUNNER = """
import json, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
from tests.support.grammars import loaded_or_said
json.dump([str(loaded_or_said(text)) for text in json.load(sys.stdin)], sys.stdout)
"""


@pytest.mark.waits
def test_a_bomb_is_a_sentence_in_little_memory_and_time(grammar_text: str) -> None:
    texts = [
        WORDS + before + (mutated(grammar_text, changes) if changes else grammar_text)
        for before, changes in BOMBS.values()
    ]
    done = process(code=RUNNER, input=json.dumps(texts).encode())

    assert (done.returncode, done.stderr) == (0, b"")
    for name, said in zip(BOMBS, json.loads(done.stdout), strict=True):
        assert re.fullmatch(r"(?!Protocol\(|.*MemoryError).{1,399}", said), f"{name}: {said[:500]}"
        assert said.isprintable(), name


# --------------------------------------------------------------------------------------------------


def test_names_of_a_grammars_own_are_let_alone() -> None:
    load(
        mutated(
            FRAMED["relay_board"],
            {"TIMING =": "LINES = 3\nSTATES = Whole(0, LINES)\nX = STATES\nTIMING ="},
        )
    )


def test_a_name_means_the_file_of_the_folder_that_one_is_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: Protocol
) -> None:
    for version in ("one", "other"):
        folder = tmp_path / version
        folder.mkdir()
        text = protocol.source.replace(f'"{protocol.version}"', f'"{version}"')
        (folder / "mine.py").write_text(text, encoding="utf-8")
        monkeypatch.chdir(folder)
        assert load_protocol("mine.py").version == version
