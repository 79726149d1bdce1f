"""The command on a terminal of its own: what is typed goes in, what it shows is waited for."""

from __future__ import annotations

import fcntl
import os
import re
import select
import shlex
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from tests.support import ROOT

CONTINUE = "fg; echo ended with $?\n"
PATIENCE = 30.0  # s; a test that waits longer hangs
CTRL_C, CTRL_D, CTRL_Z, UP, TAB = "\x03", "\x04", "\x1a", "\x1b[A", "\t"
_ESCAPE = re.compile(r"\x1b(\[[0-?]*[ -/]*[@-~]|\][^\x07]*\x07|[()][A-Z0-9]|.)")


class Terminal:
    """A terminal with the command in it; `shown` is all that it has printed, without escapes."""

    def __init__(self, process: subprocess.Popen[bytes], master: int) -> None:
        self.process = process
        self.shown = ""
        self._master = master
        self._raw = b""
        self._seen = 0

    def type(self, text: str) -> None:
        os.write(self._master, text.encode())

    def wait_for(self, text: str) -> None:
        """Wait until a text is shown after the one that was waited for last."""
        until = time.monotonic() + PATIENCE
        while (at := self.shown.find(text, self._seen)) < 0:
            assert self._read(until - time.monotonic()), f"never {text!r} in: {self.shown}"
        self._seen = at + len(text)

    def end(self, typed: str = "") -> int:
        """Type what ends the command, and wait for its end; gives its exit code."""
        if typed:
            self.type(typed)
        until = time.monotonic() + PATIENCE
        while self._read(until - time.monotonic()):
            pass
        return self.process.wait(PATIENCE)

    def hang_up(self) -> None:
        """Close the terminal."""
        os.close(self._master)
        self._master = -1

    def _read(self, patience: float) -> bool:
        """Read more; False at the end, and when the patience is over."""
        if self._master < 0 or not select.select([self._master], [], [], max(patience, 0))[0]:
            return False
        try:
            data = os.read(self._master, 1 << 16)
        except OSError:  # EIO: the last program has closed the terminal
            return False
        self._raw += data
        self.shown = _ESCAPE.sub("", self._raw.decode(errors="replace")).replace("\r", "")
        return bool(data)


@contextmanager
def on_terminal(
    *arguments: str, rows: int = 24, columns: int = 100, **more: str
) -> Iterator[Terminal]:
    """Start the command on a new terminal; `more` are environment variables."""
    words = [sys.executable, "-m", "bilprov", *arguments]
    with _terminal(words, rows, columns, more) as terminal:
        yield terminal


@contextmanager
def as_job(*words: str) -> Iterator[Terminal]:
    """Start Python so in a shell on a new terminal; CTRL_Z suspends it, CONTINUE goes on."""
    shell = ["bash", "--norc", "--noprofile", "-i"]
    with _terminal(shell, 24, 200, {"PS1": "$ "}) as terminal:
        terminal.wait_for("$ ")
        terminal.type(f"{shlex.join([sys.executable, *words])}\n")
        yield terminal


@contextmanager
def _terminal(
    words: list[str], rows: int, columns: int, more: dict[str, str]
) -> Iterator[Terminal]:
    master, slave = os.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    # Nothing here answers when a program asks where the cursor is.
    variables = {"TERM": "xterm", "PROMPT_TOOLKIT_NO_CPR": "1"} | more
    process = subprocess.Popen(
        words,
        stdin=slave,
        stdout=slave,
        stderr=slave,
        cwd=ROOT,
        env=os.environ | variables,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(slave)
    terminal = Terminal(process, master)
    try:
        yield terminal
    finally:
        with suppress(OSError):
            terminal.hang_up()
        if process.poll() is None:
            process.kill()
        process.wait()
