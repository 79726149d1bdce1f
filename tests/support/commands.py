"""Runs the command `bilprov`, in this process or in a process of its own."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, chdir, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click

from bilprov import __main__ as front_door
from bilprov.__main__ import main
from tests.support import ROOT

PATIENCE = 180  # s; a command of 10 s takes a minute on a busy machine
# What would colour or widen the output of a test that somebody runs in a terminal.
_TERMINAL = ("FORCE_COLOR", "COLUMNS")

COMMANDS = [name for name, row in front_door.COMMANDS.items() if isinstance(row, front_door.Row)]
"""The names of all commands that do something, like `capture cut`; groups are none."""

Done = subprocess.CompletedProcess[bytes]


def _variables(more: dict[str, str]) -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in _TERMINAL} | more


def command_named(name: str) -> tuple[click.Command, click.Context]:
    """The command or group of that name, as the front door loads it, and a context for it."""
    found: click.Command = front_door.front_door
    context = found.context_class(found, info_name="bilprov", resilient_parsing=True)
    for word in name.split():
        assert isinstance(found, click.Group)
        _, below, _ = found.resolve_command(context, [word])
        assert below is not None, name
        context = below.context_class(below, context, word, resilient_parsing=True)
        found = below
    return found, context


def parsed(line: str) -> list[str]:
    """Parse a command line up to a pipe or a comment; gives the words of its commands.

    Fails where there is no such command or option, or an argument is missing or too many.
    """
    words = shlex.split(line.split(" | ")[0], comments=True)
    found: click.Command = front_door.front_door
    context = found.context_class(found, info_name="bilprov")
    names: list[str] = []
    while isinstance(found, click.Group):
        parser = found.make_parser(context)
        parser.allow_interspersed_args = False
        _, words, _ = parser.parse_args(words)
        if not words:
            return names
        if words[0] == "help":
            words = words[1:]
            continue
        name, below, words = found.resolve_command(context, words)
        assert name
        assert below, line
        names.append(name)
        found, context = below, below.context_class(below, context, name)
    if "--help" not in words:
        found.make_parser(context).parse_args(words)
    return names


def command(*arguments: str, stdin: bytes = b"", cwd: Path = ROOT, **environment: str) -> Done:
    """The command in this process, without a terminal: it costs no start of Python.

    Use `process` where signals, pipes, encodings, or what is imported are what a test is about.
    """
    written = []
    with ExitStack() as stack:
        files = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(3)]
        files[0].write(stdin)
        files[0].seek(0)
        with ExitStack() as streams:
            # Descriptors of their own: the command may turn its output to nowhere.
            ends = [os.dup(file.fileno()) for file in files]
            came, out, err = (
                streams.enter_context(
                    io.TextIOWrapper(os.fdopen(end, mode), encoding="utf-8", newline="\n")
                )
                for end, mode in zip(ends, ("rb", "wb", "wb"), strict=True)
            )
            streams.enter_context(patch.multiple(sys, stdin=came, stdout=out, stderr=err))
            streams.enter_context(patch.dict(os.environ, _variables(environment), clear=True))
            streams.enter_context(chdir(cwd))
            try:
                main(arguments)
            except SystemExit as end:
                code = end.code
        for file in files[1:]:
            file.seek(0)
            written.append(file.read())
    assert isinstance(code, int)
    return subprocess.CompletedProcess(arguments, code, *written)


def process(*arguments: str, code: str = "", **options: Any) -> Done:
    """The command, or Python code around it, as a process without a terminal.

    `options` are those of subprocess.run; `env` holds what its environment has besides ours.
    """
    options = {"timeout": PATIENCE, "cwd": ROOT} | options
    variables = _variables({"PYTHONPATH": str(ROOT / "src")} | options.pop("env", {}))
    if not {"stdin", "input"} & set(options):
        options["stdin"] = subprocess.DEVNULL
    start = ["-c", code] if code else ["-m", "bilprov"]
    words = [sys.executable, *start, *arguments]
    return subprocess.run(words, capture_output=True, env=variables, check=False, **options)


class Running:
    """The command while it runs."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bilprov", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
            bufsize=0,  # `communicate` does not give what a buffer holds
            process_group=0,  # in the group of tests run in the background nothing is suspended
        )
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.stdout, self.stderr = self.process.stdout, self.process.stderr

    def wait_for(self, path: Path) -> None:
        """Wait until the capture exists: from then on the ports are open."""
        give_up = time.monotonic() + PATIENCE
        while not path.exists():
            assert self.process.poll() is None, self.stderr.read().decode()
            assert time.monotonic() < give_up
            time.sleep(0.01)

    def end(self, how: signal.Signals = signal.SIGINT) -> tuple[int, bytes, bytes]:
        """Stop it; gives exit code, standard output and standard error."""
        self.process.send_signal(how)
        return self.result()

    def result(self) -> tuple[int, bytes, bytes]:
        """Wait for its end."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


@contextmanager
def running(*arguments: str) -> Iterator[Running]:
    command = Running(*arguments)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.kill()
        command.process.wait()
        command.stdout.close()
        command.stderr.close()
