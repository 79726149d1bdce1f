"""What the pages show people: their Python, the commands they list, and how a reader runs them."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

from bilprov.analyzer.transport.port import open_pty
from tests.support import ROOT
from tests.support.robots import simulate

PATIENCE = 60.0  # s; a command that takes longer hangs
PROGRAMS = Path(sys.executable).parent

# Commands that go on until Ctrl-C, which a reader types when he has seen enough.
_ENDLESS = re.compile(r"bilprov (sniff(?!.*--(count|duration))|simulate(?!.*--list-)|lab line)")
# On a device in real time these take a minute, so a part of them is run. What they find on a busy
# machine is not for a test of the pages to judge.
_IN_REAL_TIME = re.compile(r"bilprov conform (?!sim)")
_TAPS = re.compile(r"bilprov (sniff|ports) /dev/tty\w+ /dev/tty\w+|bilprov sniff /dev/tty\w+ *$")

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
        """The exit statuses that the page gives it: 0 unless its comment names one.

        `exit status 1` is that, `exit status 1 if ...` and `exit status 0 or 1` are either. Where
        output is shown, it tells how the command ended.
        """
        if self.output is not None:
            return {0, 1, 2, 3}
        found = {1, 3} if _IN_REAL_TIME.match(self.line) else set()
        named = re.search(r"# .*exit status (\d)( or \d| if )?", self.line)
        if not named:
            return found | {0}
        if not named[2]:
            return found | {int(named[1])}
        return found | {0, int(named[1]), *map(int, re.findall(r"\d", named[2]))}


def pages() -> list[Path]:
    """Every page that people read."""
    return sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")])


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
    """Somebody who types what a page shows, in a folder, with a robot and two taps at hand."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._robot: dict[str, str] = {}
        self._ports: dict[str, str] = {}  # of the page's own servers, and free ones
        self._taps: Sequence[str] = ()
        self._background: list[subprocess.Popen[str]] = []

    @contextmanager
    def at_the_desk(self, text: str) -> Iterator[Reader]:
        """Plug in what the page speaks of; what was begun is ended on the way out."""
        taps = re.search(r"/dev/ttyUSB1", text)
        with simulate(pty=True) as robot, _traffic(bool(taps)) as names:
            self._robot = {"port": robot.port, "probe": robot.probe.removeprefix("tcp:")}
            self._taps = names
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
        found = text.replace(PROBE, self._robot["probe"])
        for page, free in self._ports.items():
            found = found.replace(page, free)
        if self._taps and _TAPS.search(text):
            first, second = self._taps
            return found.replace("/dev/ttyUSB0", first).replace("/dev/ttyUSB1", second)
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


@contextmanager
def _traffic(wanted: bool) -> Iterator[Sequence[str]]:
    """Two ptys at which a conversation of host and device is heard, again and again."""
    if not wanted:
        yield ()
        return
    ended = threading.Event()
    with open_pty() as host, open_pty() as device:

        def speak() -> None:
            frames = ["11 50", "20", "41 40", "81 05", "81 09", "92 11 ff", "00"]
            while not ended.is_set():
                for frame in map(bytes.fromhex, frames):
                    host.write_some(frame)
                    answer = {0x81: b"\2" if frame[-1] > 7 else b"\0", 0x92: b"\1"}
                    time.sleep(0.002)
                    device.write_some(answer.get(frame[0], b"\0"))
                    if ended.wait(0.05):
                        return

        thread = threading.Thread(target=speak)
        thread.start()
        try:
            yield host.name, device.name
        finally:
            ended.set()
            thread.join()
