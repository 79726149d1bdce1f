"""The command line and the package import, as processes: what they load and print, how they end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from inspect import cleandoc
from pathlib import Path
from types import SimpleNamespace

import click
import pytest

import bilprov
from bilprov import __main__ as front_door
from bilprov import decode, encode, explain, judge, read_capture
from bilprov.analyzer.grammar_file import SHIPPED
from bilprov.analyzer.output.help import examples_in
from bilprov.captures.schemas import Chunk
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.commands import Done, command, command_named, parsed, process

HEAVY = {
    *("serial", "construct", "mcap", "numpy", "rich", "msgspec"),
    *("importlib.metadata", "pyarrow", "aalpy"),
}
# Modules and packages that a command does not use.
UNUSED = {
    "--help": HEAVY,
    "decode 2111": HEAVY - {"construct", "msgspec"} | {"zstandard", "lz4", "difflib"},
    "decode 2111 --filter faulty": HEAVY - {"construct", "msgspec", "numpy"},
    "encode Stop": HEAVY - {"construct", "msgspec"},
    "spec emit c": HEAVY - {"construct", "msgspec"},
    "export captures/samples/examples.mcap --format csv -o -": {"serial", "rich", "pyarrow"},
    "completion fish": HEAVY - {"msgspec"},
    "simulate --list-faults": {"mcap", "numpy", "rich", "bilprov.conformance.cases"},
    "send sim": {"prompt_toolkit", "rich", "numpy", "mcap"},
    "conform sim --level smoke --list": {"mcap", "numpy", "rich", "importlib.metadata"},
    "conform sim --only link/*": {"bilprov.conformance.mutation", "textual", "pyarrow"},
    "replay --rate 0 captures/samples/examples.mcap": {"textual", "bilprov.analyzer.screen"},
}


def loaded(*arguments: str) -> set[str]:
    """The modules that a command has imported when it ends, and the packages that they are of."""
    code = (
        "import sys, atexit, bilprov\n"
        "atexit.register(lambda: sys.stderr.write(' '.join(sys.modules)))\n"
        "bilprov.main()"
    )
    result = process(*arguments, code=code)
    assert result.returncode == 0
    names = result.stderr.decode().split()
    return set(names) | {name.split(".")[0] for name in names}


@pytest.mark.sample(6)
@pytest.mark.waits
@pytest.mark.parametrize("line", UNUSED)
def test_a_command_loads_nothing_that_it_does_not_use(line: str) -> None:
    assert loaded(*line.split()) & UNUSED[line] == set()


def test_no_help_page_loads_what_draws_screens_and_tables() -> None:
    code = (
        "import sys, bilprov\n"
        "for line in sys.argv[1:]:\n"
        "    try: bilprov.main([*line.split(), '--help'])\n"
        "    except SystemExit: pass\n"
        "sys.stderr.write(' '.join(sys.modules))"
    )
    result = process(*front_door.COMMANDS, code=code)
    assert result.returncode == 0
    assert result.stdout.count(b"Usage: ") == len(front_door.COMMANDS)
    assert {"numpy", "rich", "textual"}.isdisjoint(result.stderr.decode().split())


def test_importing_the_library_loads_nothing_heavy() -> None:
    result = process(code="import sys, bilprov; print(*sys.modules)")
    assert not HEAVY & set(result.stdout.decode().split())


@pytest.mark.parametrize("variable", [{"LC_ALL": "C"}, {"PYTHONIOENCODING": "ascii"}])
def test_a_narrow_locale_is_no_reason_to_fail(variable: dict[str, str]) -> None:
    result = process("spec", "show", env=variable)
    assert (result.returncode, result.stderr) == (0, b"")


Failing = Callable[[BaseException], Done]


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Failing:
    """Runs a command that raises an exception."""

    def run(error: BaseException) -> Done:
        def body() -> None:
            raise error

        module = SimpleNamespace(broken=click.command("broken")(body))
        monkeypatch.setitem(sys.modules, "bilprov.broken", module)
        monkeypatch.setitem(front_door.COMMANDS, "broken", front_door.Row("broken", ""))
        return command("broken")

    return run


def test_a_bug_shows_its_traceback_and_does_not_blame_the_device(failing: Failing) -> None:
    result = failing(KeyError("oops"))
    *shown, last = result.stderr.decode().splitlines()

    assert result.returncode == 2
    assert shown[0].startswith("Traceback")
    assert shown[-1] == "KeyError: 'oops'"
    assert last.startswith("bilprov: this is a bug in bilprov, not in the device")


NO_MEMORY = "memory ran out: close other programs, raise its limit (ulimit -v), or ask for less"


@pytest.mark.parametrize(
    ("error", "status", "sentence"),
    [
        (OSError(28, "No space left on device", "x"), 2, "x: No space left on device"),
        (OSError(24, "Too many open files"), 2, "Too many open files"),
        (MemoryError(), 2, NO_MEMORY),
        (SystemExit(3), 3, ""),
        (SystemExit(), 0, ""),
        (click.exceptions.Exit(1), 1, ""),
        (KeyboardInterrupt(), 130, ""),
    ],
    ids=repr,
)
def test_a_fault_of_the_system_is_one_sentence_and_an_exit_code_that_is_asked_for_none(
    failing: Failing, error: BaseException, status: int, sentence: str
) -> None:
    result = failing(error)

    assert (result.returncode, result.stdout) == (status, b"")
    assert result.stderr.decode() == (f"bilprov: {sentence}\n" if sentence else "")


def test_a_signal_in_the_middle_ends_quietly_with_130(tmp_path: Path) -> None:
    fifo = tmp_path / "grammar.py"
    os.mkfifo(fifo)  # reading it waits until somebody writes
    process = subprocess.Popen(
        [sys.executable, "-m", "bilprov", "--grammar", str(fifo), "spec", "show"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    with fifo.open("wb"):  # returns once the command reads
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, b"", b"")


@pytest.mark.parametrize("name", front_door.COMMANDS)
def test_each_command_has_a_help_page_with_an_example_at_its_head(name: str) -> None:
    words = name.split()
    shown = command(*words, "--help").stdout.decode()
    usage, _, examples, *_ = shown.split("\n\n")

    assert usage.startswith(f"Usage: bilprov {name}")
    assert examples.startswith(f"  Examples:\n    bilprov {name}")
    for same in ([*words, "-h"], ["help", *words]):
        assert command(*same).stdout.decode() == shown


def examples() -> list[tuple[str, str]]:
    """Each example of each help page, with the command of the page."""
    found = []
    for name in ["", *front_door.COMMANDS]:
        page, _ = command_named(name)
        found += [(name, line) for line in examples_in(cleandoc(page.help or ""))]
    return found


@pytest.mark.parametrize(("name", "line"), examples())
def test_an_example_of_a_help_page_is_a_line_that_the_command_takes(name: str, line: str) -> None:
    program, _, rest = line.partition(" ")

    assert program == "bilprov"
    assert len(line) <= 76
    assert parsed(rest)[0] == (name.split() or parsed(rest))[0]


def test_the_library_hands_on_exactly_what_it_lists() -> None:
    assert dir(bilprov) == bilprov.__all__
    for name in bilprov.__all__:
        assert getattr(bilprov, name).__doc__


def test_an_unknown_name_of_the_library_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'frob'"):
        bilprov.frob  # noqa: B018


@pytest.mark.parametrize("name", list(SHIPPED))
def test_a_grammar_of_the_kit_is_known_by_its_name(name: str) -> None:
    listed = json.loads(command("spec", "grammars", "--format", "json").stdout)
    text = command("spec", "emit", "grammar", name).stdout

    assert [one["name"] for one in listed] == list(SHIPPED)
    assert text == (ROOT / "spec" / SHIPPED[name]).read_bytes()
    assert command("spec", "emit", "grammar", "--grammar", name).stdout == text


# -- a grammar by its name and by its file ---------------------------------------------------------


RELAY = ROOT / "examples" / "relay_board.py"
ON = bytes.fromhex("5556000000 02 01 AE")


def test_a_grammar_is_given_by_name_and_by_file(tmp_path: Path) -> None:
    assert encode("On", {"address": 2}, RELAY) == encode("On", {"address": 2}, str(RELAY)) == ON
    assert encode("Ping", {"address": 1}, "dynamixel1").hex(" ") == "ff ff 01 02 01 fb"
    assert judge(ON, RELAY).describe() == "@2 On"
    assert explain(ON, protocol=RELAY).frames[0].judgement.valid
    assert [one.words for one in decode(ON, protocol=RELAY)] == ["@2 On"]

    file = write_capture(tmp_path / "line.mcap", [Chunk(0, "host", ON)])
    assert next(iter(read_capture(file, RELAY))).words == "@2 On"  # type: ignore[union-attr]
