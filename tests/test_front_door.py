"""The command line and the package import, as processes: what they load and print, how they end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import tomllib
from contextlib import closing
from importlib import import_module
from pathlib import Path

import click
import pytest

import bilprov
from bilprov import __main__ as front_door
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT
from tests.support.commands import Done, command, process
from tests.support.signals import ignoring

HEAVY = {
    "serial",
    "construct",
    "mcap",
    "numpy",
    "rich",
    "msgspec",
    "importlib.metadata",
    "pyarrow",
    "aalpy",
}
# Modules and packages that a command does not use.
UNUSED = {
    "decode 2111": HEAVY - {"construct", "msgspec"} | {"zstandard", "lz4", "difflib"},
    "decode 2111 --filter faulty": HEAVY - {"construct", "msgspec"}
    | {"zstandard", "lz4", "difflib"},
    "encode Stop": HEAVY - {"construct", "msgspec"},
    "spec emit c": HEAVY - {"construct", "msgspec"},
    "spec emit wireshark": HEAVY - {"construct", "msgspec"},
    "export --foxglove-layout": {"serial", "mcap", "numpy", "rich", "pyarrow"},
    "export captures/samples/examples.mcap --format csv -o -": {
        "serial",
        "mcap",
        "rich",
        "pyarrow",
    },
    "completion fish": HEAVY,
    "simulate --list-faults": {"mcap", "numpy", "rich", "bilprov.conformance.cases"},
    "shell sim": {"prompt_toolkit", "rich", "numpy", "mcap"},
    "conform sim --list": {"mcap", "numpy", "rich", "importlib.metadata"},
    "replay --rate 0 captures/samples/examples.mcap": {"textual", "bilprov.analyzer.screen"},
    "replay --plain --rate 0 captures/samples/examples.mcap": {"textual"},
} | {f"{name} --help": {"numpy", "rich", "textual"} for name in front_door.COMMANDS}


def said(result: Done) -> str:
    """The one sentence on standard error; fails where there is more, or a traceback."""
    assert result.returncode == 2, result
    assert result.stdout == b""
    lines = result.stderr.decode().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("bilprov: ")
    return lines[0]


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


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["encode", "--help"]])
def test_help_and_version_load_nothing_heavy(arguments: list[str]) -> None:
    assert loaded(*arguments) & HEAVY == set()


@pytest.mark.waits
@pytest.mark.parametrize("line", UNUSED)
def test_a_command_loads_nothing_that_it_does_not_use(line: str) -> None:
    assert loaded(*line.split()) & UNUSED[line] == set()


def test_importing_the_library_loads_nothing_heavy() -> None:
    result = process(code="import sys, bilprov; print(*sys.modules)")
    assert not HEAVY & set(result.stdout.decode().split())


def test_help_fits_80_columns_without_colour_codes_in_a_pipe() -> None:
    shown = process("--help", env={"GITHUB_ACTIONS": "true"}).stdout.decode()
    assert "\x1b" not in shown
    assert max(map(len, shown.splitlines())) <= 80
    for name, row in front_door.COMMANDS.items():
        assert name in shown
        assert row.panel in shown


@pytest.mark.parametrize("variable", [{"LC_ALL": "C"}, {"PYTHONIOENCODING": "ascii"}])
def test_a_narrow_locale_is_no_reason_to_fail(variable: dict[str, str]) -> None:
    result = process("spec", "show", env=variable)
    assert (result.returncode, result.stderr) == (0, b"")


def test_version_is_one_plain_line() -> None:
    name, version = process("--version").stdout.decode().split()
    assert name == "bilprov"
    assert version[0].isdigit()


def test_an_installation_gets_the_version_that_the_command_shows() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    module, _, attribute = declared["tool"]["setuptools"]["dynamic"]["version"]["attr"].rpartition(
        "."
    )

    assert declared["project"]["dynamic"] == ["version"]
    shown = command("--version").stdout.decode()
    assert shown == f"bilprov {getattr(import_module(module), attribute)}\n"


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["explian"], "no such command 'explian', did you mean explain?"),
        (["frobnicate"], "no such command 'frobnicate'; see bilprov --help"),
        (["--grammer"], "did you mean --grammar?"),
        (["--grammar"], "option '--grammar' requires an argument"),
        (["explain"], "missing argument 'HEX...'; see bilprov explain --help"),
        (["explain", "00", "--format", "xml"], "'xml' is not one of"),
        (["sniff", "--baud", "x"], "'x' is no whole number; see bilprov sniff --help"),
        (["sniff", "--duration", "x"], "'x' is no number; see bilprov sniff --help"),
        (["explain", "00", "--grammar", "x.py"], "it goes before the subcommand"),
        (["ports", "extra"], "unexpected extra argument (extra)"),
        (["--grammar", "/nowhere/g.py", "spec", "show"], "cannot be read"),
        (["info", "/nowhere/c.mcap"], "does not exist"),
        (["explain", "\x1b[31mred\u202e"], "is not hex"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_2(arguments: list[str], part: str) -> None:
    sentence = said(command(*arguments))
    assert part in sentence
    assert sentence.isprintable()


@pytest.mark.parametrize(
    ("source", "part"),
    [
        ("", "declares no HEADER"),
        ("def (", "SyntaxError"),
        ("1/0", "ZeroDivisionError"),
        ("raise SystemError('a\\nb')", "SystemError: a b"),
    ],
)
def test_a_grammar_that_does_not_load_is_one_sentence(
    tmp_path: Path, source: str, part: str
) -> None:
    file = tmp_path / "g.py"
    file.write_text(source)
    assert part in said(command("--grammar", str(file), "explain", "00"))


def test_no_arguments_show_the_help_as_wrong_use() -> None:
    result = process()
    assert (result.returncode, result.stdout) == (2, b"")
    assert b"Usage: bilprov" in result.stderr


BROKEN_COMMAND = """
import sys, bilprov, types
from bilprov import __main__ as front_door
import click
module = types.ModuleType("broken")
def body(*, error={error}):
    raise error
module.broken = click.command("broken")(body)
sys.modules["broken"] = module
front_door.COMMANDS["broken"] = front_door.Row("Analyze", "broken", "broken", "")
bilprov.main(["broken"])
"""


def test_a_bug_shows_its_traceback_and_does_not_blame_the_device() -> None:
    result = process(code=BROKEN_COMMAND.format(error="KeyError('oops')"))
    assert result.returncode == 2
    said = result.stderr.decode()
    assert "Traceback" in said
    assert "KeyError: 'oops'" in said
    assert said.splitlines()[-1].startswith("bilprov: this is a bug in bilprov, not in the device")


OPEN = "too many files are open: close some, or raise the limit (ulimit -n)"
SYSTEM = {
    "OSError(28, 'No space left on device', 'x')": "x: No space left on device",
    "OSError(24, 'Too many open files', 'x')": f"x cannot be opened, because {OPEN}",
    "OSError(24, 'Too many open files')": OPEN,
    "MemoryError()": (
        "memory ran out: close other programs, raise its limit (ulimit -v), or ask for less"
    ),
}


@pytest.mark.parametrize("error", SYSTEM)
def test_a_fault_of_the_system_is_one_sentence(error: str) -> None:
    result = process(code=BROKEN_COMMAND.format(error=error))
    assert said(result) == f"bilprov: {SYSTEM[error]}"


@pytest.mark.parametrize(
    ("error", "status"),
    [("SystemExit(3)", 3), ("SystemExit()", 0), ("click.exceptions.Exit(1)", 1)],
)
def test_a_command_ends_with_the_exit_code_it_asks_for(error: str, status: int) -> None:
    assert process(code=BROKEN_COMMAND.format(error=error)).returncode == status


def test_ctrl_c_ends_quietly_with_130() -> None:
    result = process(code=BROKEN_COMMAND.format(error="KeyboardInterrupt()"))
    assert (result.returncode, result.stdout, result.stderr) == (130, b"", b"")


def test_a_signal_in_the_middle_ends_quietly_with_130(tmp_path: Path) -> None:
    fifo = tmp_path / "grammar.py"
    os.mkfifo(fifo)  # reading it waits until somebody writes
    with ignoring():
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


def test_a_reader_that_goes_away_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    result = subprocess.run(
        [sys.executable, "-m", "bilprov", "spec", "readings"],
        cwd=ROOT,
        stdout=writer,
        stderr=subprocess.PIPE,
        timeout=60,
        check=False,
    )
    os.close(writer)
    assert (result.returncode, result.stderr) == (0, b"")


def test_a_full_disk_is_one_sentence() -> None:
    with Path("/dev/full").open("wb") as full:
        result = subprocess.run(
            [sys.executable, "-m", "bilprov", "encode", "Stop"],
            cwd=ROOT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    assert (result.returncode, result.stderr) == (
        2,
        "bilprov: standard output: No space left on device\n",
    )


@pytest.mark.parametrize("name", front_door.COMMANDS)
def test_every_subcommand_is_where_the_table_says(name: str) -> None:
    context = click.Context(front_door.front_door)
    _, command, _ = front_door.front_door.resolve_command(context, [name])
    assert command is not None
    assert command.name == name


@pytest.mark.parametrize("name", front_door.COMMANDS)
def test_every_subcommand_explains_itself(name: str) -> None:
    result = command(name, "--help")
    assert (result.returncode, result.stderr) == (0, b"")
    shown = result.stdout.decode()
    assert f"Usage: bilprov {name}" in shown
    assert max(map(len, shown.splitlines())) <= 80


def test_the_library_hands_on_exactly_what_it_lists() -> None:
    assert sorted(bilprov.__all__) == sorted(bilprov.API)
    assert dir(bilprov) == sorted(bilprov.__all__)
    for name in bilprov.__all__:
        assert getattr(bilprov, name).__doc__


def test_an_unknown_name_of_the_library_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'frob'"):
        bilprov.frob  # noqa: B018


def test_the_library_decodes_encodes_and_explains() -> None:
    (record,) = bilprov.decode(b"\x81\x05")
    assert record.value.fields == {"rgb": 5}
    (answer,) = bilprov.decode(b"\x02", "device")
    assert answer.value.name == "BAD_DATA"
    assert bilprov.encode("LED", {"rgb": 5}) == b"\x81\x05"
    assert bilprov.judge(b"\x81\x09").response.name == "BAD_DATA"
    assert len(bilprov.explain(b"\x20\x00").frames) == 2
    assert len(bilprov.explain(b"\x20\x00", "device").responses) == 2
    assert bilprov.load_protocol().name


def test_the_library_reads_a_capture_as_decoded_records(tmp_path: Path) -> None:
    file = tmp_path / "c.mcap"
    with CaptureWriter(file, start_wall=0, metadata={}, version="1") as writer:
        writer.chunk(Chunk(0, "host", b"\x81\x05"))
        writer.chunk(Chunk(2_000_000, "device", b"\x02"))
    instruction, answer = bilprov.read_capture(file)
    assert instruction.value.name == "LED"
    assert (answer.value.instruction, answer.value.latency) == (0, 2_000_000)
    assert answer.value.agrees is False
    assert len(list(bilprov.open_capture(file))) == 2


def test_the_library_sniffs_two_ports_as_an_iterator() -> None:
    heard = threading.Event()

    def keep_sending(port: int) -> None:
        while not heard.wait(0.05):  # opening a port throws away what was sent before
            os.write(port, b"\x81\x05")

    with open_pty() as host, open_pty() as device:
        sender = threading.Thread(target=keep_sending, args=(host.master,))
        sender.start()
        try:
            with closing(bilprov.sniff(host.name, device.name)) as records:
                instruction = next(records)
                os.write(device.master, b"\x00")
                answer = next(record for record in records if isinstance(record, DeviceRecord))
        finally:
            heard.set()
            sender.join()
    assert isinstance(instruction, HostRecord)
    assert instruction.data == b"\x81\x05"
    assert answer.value.agrees is True


def test_sniffing_one_line_twice_is_refused() -> None:
    with open_pty() as host, pytest.raises(ValueError, match="tapped"):
        next(bilprov.sniff(host.name, host.name))
