"""What people read: each snippet and command runs as it stands, and prints what a page shows."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.safe_grammar import WORDS
from examples.demo import FILES
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.commands import command, parsed, process
from tests.support.decoding import conversation
from tests.support.robots import simulate

PATIENCE = 60.0  # s; a command that takes longer hangs
PROGRAMS = Path(sys.executable).parent

# Commands that go on until Ctrl-C, which a reader types when he has seen enough.
_ENDLESS = re.compile(r"bilprov (sniff(?!.*--(count|duration))|simulate(?!.*--list-)|lab line)")
# On a device in real time these take a minute, so a part of them is run. What they find on a busy
# machine is not for a test of the pages to judge.
_IN_REAL_TIME = re.compile(r"bilprov conform (?!sim)")
_TAPS = re.compile(r"(?<=bilprov sniff )/dev/tty\w+ /dev/tty\w+")

DEVICE = re.compile(r"(?<![\w.])/dev/(?:tty(?:USB|ACM)\d|serial/by-id/[\w-]+)|\bPORT\b")
PROBE = "robot.local:9000"


@dataclass(frozen=True)
class Step:
    """A command line of a page, and the output below it; None where a page shows none."""

    line: str
    output: str | None = None

    @property
    def command(self) -> str:
        """The line without its comment."""
        return re.sub(r"\s+# .*", "", self.line).removesuffix(" &")

    @property
    def background(self) -> bool:
        return self.line.endswith(" &")

    @property
    def statuses(self) -> set[int]:
        """The exit statuses that are right: 0, and what the comment names, or as output shows."""
        if self.output is not None:
            return {0, 1, 2, 3}
        named = re.search(r"# .*exit status (\d)(?: or (\d))?", self.line)
        found = {1, 3} if _IN_REAL_TIME.match(self.line) else set()
        return {0} | found | {int(status) for status in (named.groups("0") if named else ())}


def blocks(text: str) -> list[tuple[str, str]]:
    """Each block of code of a page: its language (`indented` without a fence) and its text."""
    return [
        (token.info if token.type == "fence" else "indented", token.content)
        for token in MarkdownIt().parse(text)
        if token.type in ("fence", "code_block")
    ]


def snippets(text: str) -> list[tuple[str, str | None]]:
    """Each Python snippet of a page, and the output that is shown right below it.

    That is a `text` block, or a line in the words "It prints".
    """
    output = r"(?:\n\n(?:```text\n(?P<block>.*?)^```$|It prints `(?P<line>[^`\n]*)`))?"
    found = re.finditer(rf"^```python\n(.*?)^```${output}", text, re.DOTALL | re.MULTILINE)
    return [
        (match[1], match["block"] or (match["line"] and match["line"] + "\n")) for match in found
    ]


def steps(text: str) -> list[Step]:
    """The commands of a page's `console`, `sh` and indented blocks, in their order."""
    found: list[Step] = []
    for kind, block in blocks(text):
        if kind in ("indented", "sh"):
            lines = re.sub(r"(\||\\)\n\s*", r"\1 ", block).splitlines()
            found += [Step(line.strip()) for line in lines if line.strip()]
        elif kind == "console":
            first, *rest = re.split(r"^\$ ", block, flags=re.MULTILINE)
            assert not first, f"output without a command: {first}"
            parts = [part.partition("\n") for part in rest]
            found += [Step(line, output) for line, _, output in parts]
    return found


def matches(shown: str, printed: str) -> bool:
    """Whether a command printed what a page shows.

    `...` stands for anything in a line, and alone in a line for any lines. Spaces and times count
    as equal.
    """
    pattern = ""
    for line in _plain(shown).splitlines():
        if line.strip() == "...":
            pattern += r"(?:.*\n)*?"
        else:
            pattern += ".*?".join(map(re.escape, line.split("..."))) + r"\n"
    return re.fullmatch(pattern, _plain(printed)) is not None


def _plain(text: str) -> str:
    """The text with one space for several, no empty lines, and 0 for times."""
    text = re.sub(r"\b\d+\.\d{6}\b|\b\d+(\.\d+)?(?= ?(ms|s)\b)", "0", text)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    return "".join(f"{line}\n" for line in lines if line)


class Reader:
    """Somebody who types what a page shows, in a folder, with a robot and simulated taps."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._robot: dict[str, str] = {}
        self._ports: dict[str, str] = {}  # of the page's own servers, and free ones
        self._background: list[subprocess.Popen[str]] = []

    @contextmanager
    def at_the_desk(self, text: str) -> Iterator[Reader]:
        """Plug in what the page speaks of; what was begun is ended on the way out."""
        with simulate(pty=True) as robot:
            self._robot = {"port": robot.port, "probe": robot.probe.removeprefix("tcp:")}
            self._ports = {f"127.0.0.1:{port}": _free() for port in re.findall(r"\b77\d\d\b", text)}
            try:
                yield self
            finally:
                for process in self._background:
                    _interrupt(process)
                    process.communicate(timeout=PATIENCE)

    def settings(self, text: str) -> None:
        """Put a page's settings into the reader's own file."""
        file = self.folder / "settings" / "bilprov" / "config.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self._here(text), encoding="utf-8")

    def patch(self, text: str) -> None:
        """Make the change that a page shows in horn.py."""
        file = self.folder / "horn.py"
        grammar = (ROOT / "spec" / "grammar.py").read_text(encoding="utf-8")
        added = "".join(f"{line[1:]}\n" for line in text.splitlines() if line.startswith("+"))
        end = "}\n\nFRAME ="
        assert grammar.count(end) == 1
        file.write_text(grammar.replace(end, added + end), encoding="utf-8")

    def types(self, step: Step) -> tuple[int, str]:
        """Run a step's command; gives its exit status and all that it printed."""
        line = self._here(step.command)
        if _IN_REAL_TIME.match(step.command):
            line += " --level smoke --only 'link/*' --truncation-timeout 50"
        with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
            process = subprocess.Popen(
                ["bash", "-o", "pipefail", "-c", line],
                cwd=self.folder,
                env=self._environment(),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
            if step.background:
                self._background.append(process)
                _wait_for_output(process, output.fileno())
                return 0, step.output or ""
            try:
                if _ENDLESS.search(step.command):
                    _wait_for_output(process, output.fileno())
                    _interrupt(process)
                status = process.wait(PATIENCE)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
            output.seek(0)
            return status, self._there(output.read())

    def _here(self, text: str) -> str:
        """The text with the ports and the probe of this machine for those of the page."""
        found = _TAPS.sub("sim", text.replace(PROBE, self._robot["probe"]))
        for page, free in self._ports.items():
            found = found.replace(page, free)
        return DEVICE.sub(self._robot["port"], found)

    def _there(self, text: str) -> str:
        """What was printed, with the page's ports again."""
        found = text.replace(self._robot["port"], "/dev/ttyUSB0")
        for page, free in self._ports.items():
            found = found.replace(free, page)
        return found

    def _environment(self) -> dict[str, str]:
        return {
            **os.environ,
            "PATH": f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT / "src"),
            "XDG_CONFIG_HOME": str(self.folder / "settings"),
        }


def _free() -> str:
    """An address of this machine at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def _interrupt(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)


def _wait_for_output(process: subprocess.Popen[str], output: int) -> None:
    """Wait until a command has printed something, so that it is under way; a quiet one gets 3 s."""
    quiet = time.monotonic() + 3
    while process.poll() is None and time.monotonic() < quiet and not os.fstat(output).st_size:
        time.sleep(0.05)
    time.sleep(0.3)


# Every page that people read.
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")])
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}

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
    r"bilprov ports \S+ /dev/ttyUSB1": "needs two taps; tests/analyzer/doctor runs it",
}
# What a command needs beside Python.
NEEDS = ("tshark", "jq")
SIDES = ("host", "device")


def is_run(step: Step) -> bool:
    return not any(re.match(pattern, step.line) for pattern in NOT_RUN)


# The steps of each page that a test runs.
RUNS = {name: list(filter(is_run, steps(text))) for name, text in TEXTS.items()}
SNIPPETS = [
    pytest.param(*snippet, id=f"{Path(name).name}-{number}")
    for name, text in TEXTS.items()
    for number, snippet in enumerate(snippets(text), 1)
]


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
    drive = (b"\x11\x50", b"\0"), (b"\x20", b"\0"), (b"\x81\x09", b"\2"), (b"\0", b"\0")
    write_capture(path, [chunk for chunk in conversation(drive) if chunk.direction in sides])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder with the capture that the pages read."""
    record(tmp_path / "drive.mcap", *SIDES)
    return tmp_path


@pytest.mark.sample(4)
@pytest.mark.waits
@pytest.mark.parametrize(("text", "output"), SNIPPETS)
def test_a_python_snippet_runs_as_it_stands(text: str, output: str | None, folder: Path) -> None:
    path = f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", text],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        timeout=PATIENCE,
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
@pytest.mark.parametrize("page", [page for page in RUNS if RUNS[page] and page != "README.md"])
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
