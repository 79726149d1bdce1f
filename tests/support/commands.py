"""Runs the command `bilprov` to its end, in this process or in a process of its own."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, chdir
from pathlib import Path
from typing import Any
from unittest.mock import patch

from bilprov.__main__ import main
from tests.support import ROOT

PATIENCE = 60.0  # s; a test that waits longer hangs
# What would colour or widen the output of a test that somebody runs in a terminal.
_TERMINAL = ("FORCE_COLOR", "COLUMNS")

Done = subprocess.CompletedProcess[bytes]


def _variables(more: dict[str, str]) -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in _TERMINAL} | more


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
