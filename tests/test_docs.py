"""What people read: each snippet and command runs as it stands, and prints what a page shows."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.safe_grammar import WORDS
from examples.demo import FILES
from tests.support import ROOT
from tests.support.commands import command, parsed, process
from tests.support.pages import PROGRAMS, Reader, Step, blocks, matches, pages, snippets, steps

PAGES = pages()
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
_PATIENCE = 60  # s

# What a page shows and no test runs, and why. The first words of a command, as a pattern.
NOT_RUN = {
    r"apt-get|pip|pipx|npm|sudo|setserial|echo .*sudo": "installs, or changes the machine",
    r"make": "is how the project is built; the other tests are what it runs",
    r"pytest --robot-port": "tests/conformance/pytest_plugin runs it",
    r"\.venv/bin/python -m benchmarks": "takes minutes",
    r"bilprov (conform emulator|simulate --firmware)": "needs firmware; tests/firmware runs it",
    r"(bilprov --grammar stk500v1|avrdude) ": "needs a bootloader; tests/firmware runs it",
    r"bilprov conform .*--watch": "goes on for ever; tests/conformance/test_watch.py runs it",
    r"bilprov lab score": "takes minutes; tests/conformance/mutation runs it",
    r"bilprov lab learn": "takes a minute; tests/conformance/learning runs it",
}
# What a command needs beside Python.
NEEDS = ("tshark", "jq")
SIDES = ("host", "device")


def runs() -> dict[str, list[Step]]:
    """The steps of each page that a test runs."""
    found = {}
    for name, text in TEXTS.items():
        kept = [s for s in steps(text) if not any(re.match(p, s.line) for p in NOT_RUN)]
        if kept:
            found[name] = kept
    return found


RUNS = runs()


def named_snippets() -> dict[str, tuple[str, str | None]]:
    """Each Python snippet with its output, named by page and number."""
    return {
        f"{Path(name).name}-{number}": snippet
        for name, text in TEXTS.items()
        for number, snippet in enumerate(snippets(text), 1)
    }


def command_lines() -> list[tuple[str, str]]:
    """Each command line of ours that a page shows, with the page's name."""
    found = []
    for name, text in TEXTS.items():
        lines = [step.line for step in steps(text)]
        prose = re.sub(r"^```\w*$.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
        inline = re.findall(r"`bilprov ([a-z][^`]*)`", " ".join(prose.split("\n")))
        shown = re.findall(r"^(?:\.venv/bin/)?bilprov (.*)$", "\n".join(lines), re.MULTILINE)
        found += [(Path(name).name, line.removesuffix(" &")) for line in [*shown, *inline]]
    return list(dict.fromkeys(found))


def record(path: Path, *sides: str) -> None:
    """Write a capture of a short drive, or of one side of it."""
    with CaptureWriter(path, start_wall=10**18, metadata={}, version="0") as capture:
        for number, frame in enumerate(("1150", "20", "8109", "00")):
            answer = b"\x02" if frame == "8109" else b"\x00"
            if "host" in sides:
                capture.chunk(Chunk(number * 20 * MS, "host", bytes.fromhex(frame)))
            if "device" in sides:
                capture.chunk(Chunk(number * 20 * MS + MS, "device", answer))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder with the capture that the pages read."""
    record(tmp_path / "drive.mcap", *SIDES)
    return tmp_path


@pytest.mark.sample(4)
@pytest.mark.waits
@pytest.mark.parametrize(("text", "output"), named_snippets().values(), ids=named_snippets().keys())
def test_a_python_snippet_runs_as_it_stands(text: str, output: str | None, folder: Path) -> None:
    path = f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", text],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        timeout=_PATIENCE,
        check=False,
    )

    assert (result.returncode, result.stderr) == (0, b"")
    assert result.stdout or "print" not in text or "except" in text
    if output is not None:
        assert result.stdout.decode() == output


def typed(page: str, folder: Path) -> None:
    """Type what a page shows; each command has to end as the page says, and print what it shows."""
    text = TEXTS[page]
    written = re.findall(r"-w (\S+)", text)
    for name in ("host", "device", "monday", "tuesday"):
        if f"{name}.mcap" in text:
            record(folder / f"{name}.mcap", *([name] if name in ("host", "device") else SIDES))
    if "drive.mcap" in written:
        (folder / "drive.mcap").unlink()
    for example in (ROOT / "examples").glob("*.py"):
        if example.name in text:
            shutil.copy(example, folder)
    with Reader(folder).at_the_desk(text) as reader:
        for kind, block in blocks(text):
            if kind == "toml":
                reader.settings(block)
            elif kind == "diff":
                reader.patch(block)
        for step in RUNS[page]:
            if any(
                re.search(rf"\b{need}\b", step.command) for need in NEEDS if not shutil.which(need)
            ):
                continue
            status, printed = reader.types(step)
            printed = re.sub(r".* ! waited: .*\n", "", printed)  # where the machine is busy
            told = f"{step.line}\n{printed}"
            assert "Traceback" not in printed, told
            assert status in step.statuses, f"exit status {status}: {told}"
            if step.output is not None:
                assert matches(step.output, printed), told


@pytest.mark.waits
def test_the_readme_shows_what_happens(folder: Path) -> None:
    typed("README.md", folder)


@pytest.mark.sample(1)
@pytest.mark.waits
@pytest.mark.timeout(400)
@pytest.mark.parametrize("page", [page for page in RUNS if page != "README.md"])
def test_a_page_shows_what_happens(page: str, folder: Path) -> None:
    typed(page, folder)


def test_the_grammar_on_the_page_is_the_example() -> None:
    text = (ROOT / "examples" / "relay_board.py").read_text(encoding="utf-8")

    assert f"```python\n{text}```\n" in TEXTS["docs/your-own-protocol.md"]


def test_the_page_has_every_word_of_a_grammar() -> None:
    text = TEXTS["docs/your-own-protocol.md"]
    code = "\n".join(re.findall(r"`([^`\n]+)`", text))
    ours = WORDS["bilprov.spec.fields"]
    construct = {word for word in WORDS["construct"] if not re.match(r"Int\d|Nibble|this", word)}

    assert [word for word in sorted(ours | construct) if not re.search(rf"\b{word}\b", code)] == []


def _values(instruction: InstructionSpec) -> str:
    return ", ".join(f"{one.low} to {one.high}" for one in instruction.fields)


def test_the_protocol_page_is_what_the_grammar_says(protocol: Protocol) -> None:
    text = TEXTS["docs/protocol.md"]
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in text.splitlines()
        if re.match(r"\| \d+ \|", line)
    ]
    instructions = [
        [str(one.id), one.name, one.document, str(one.length), _values(one)]
        for one in protocol.instructions
    ]
    answers = [[str(one.code), one.name, one.prose] for one in protocol.responses]

    assert [row[:5] for row in rows if len(row) == 6] == instructions
    assert [row for row in rows if len(row) == 3] == answers
    timing = protocol.timing
    for number in (timing.truncation_timeout, timing.answer_deadline, timing.stop_longest):
        assert f"{number} ms" in text


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_a_command_line_is_one_that_exists(page: str, line: str) -> None:
    parsed(line)


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_what_a_page_links_to_is_there(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text())

    assert [link for link in links if not (page.parent / link).exists()] == []


# -- the demonstration -----------------------------------------------------------------------------


@pytest.mark.waits
def test_the_demo_ends_well_leaves_its_files_and_names_three_commands_that_work(
    tmp_path: Path,
) -> None:
    code = "import runpy; runpy.run_module('examples.demo', run_name='__main__')"
    places = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}
    strict = places | {"PYTHONWARNINGS": "error"}
    done = process(code=code, cwd=tmp_path, env=strict, text=True, timeout=100)

    assert done.returncode == 0, done.stderr
    folder = tmp_path / "build" / "demo"
    assert {file.name for file in folder.iterdir()} == set(FILES)
    assert json.loads((folder / "conformance.json").read_text())["exit"] == 0
    # Example 5.2 as printed and as meant, example 5.3's LED as printed and as meant.
    for printed in ("40", "41 ff", "91 02", "81 02"):
        assert f" {printed} " in done.stdout
    *lines, last = done.stdout.split("Try next:\n")[1].splitlines()
    tried = [command(*shlex.split(line)[1:], cwd=tmp_path) for line in lines]
    assert [one.returncode for one in tried] == [0, 0]
    assert parsed(last.partition("bilprov ")[2]) == ["conform"]
