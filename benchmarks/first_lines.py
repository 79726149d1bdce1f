"""How long a command takes to its first line: a replay from the middle, and the shortest ones."""

from __future__ import annotations

import sys
from functools import partial

from benchmarks import captures, product
from benchmarks.commands import bilprov_words, first_line, medians
from benchmarks.report import OURS, Goal, Row
from benchmarks.setting import Setting, Work

_BEFORE_THE_END = 5_000_000  # ns
_PYTHON = [sys.executable, "-c", "print()"]


def seek(setting: Setting, work: Work) -> Row:
    """`replay --start` shortly before the end of the big capture."""
    made = captures.big(setting)
    command = product.replayed(made.path, (made.end - _BEFORE_THE_END) / 1e9)
    words = f"{work.words}, {made.frames / 1e6:.3g} M frames"
    return _beside_python(work, words, command, setting.sizes.rounds, 150)


def _start(setting: Setting, work: Work, *, words: list[str], over: float) -> Row:
    return _beside_python(work, work.words, bilprov_words(*words), setting.sizes.starts, over)


help_page = partial(_start, words=["--help"], over=60)
decoded = partial(_start, words=["decode", "2111"], over=90)


def _beside_python(work: Work, words: str, command: list[str], rounds: int, most: float) -> Row:
    """A command to its first line, which may take so many ms longer than Python alone."""
    first_line(command)  # its files are compiled and cached now
    works = {OURS: command, "python alone": _PYTHON}
    seconds = medians(rounds, {name: partial(first_line, one) for name, one in works.items()})
    found = {name: one * 1e3 for name, one in seconds.items()}
    over = found[OURS] - found["python alone"]
    goal = Goal(f"python + {most:g} ms", over, most, at_most=True)
    return work.row(words, "ms", found, goal)
