"""How long a command takes to its first line: a replay from the middle, and the shortest ones."""

from __future__ import annotations

import sys
from functools import partial

from benchmarks import captures, peers, product
from benchmarks.commands import bilprov_words, first_line, medians, timed
from benchmarks.report import OURS, Goal, Row
from benchmarks.setting import Made, Setting, Work
from bilprov.captures.reader import open_capture

_BEFORE_THE_END = 5_000_000  # ns
_SEEK, _LONGEST = 150, 6  # ms; times the patience of a row
_PYTHON = [sys.executable, "-c", "print()"]


def seek(setting: Setting, work: Work) -> Row:
    """`replay --start` shortly before the end of the small and of the big capture."""
    few, made = captures.small(setting), captures.big(setting)
    for one in (few, made):
        first_line(_seeking(one), _LONGEST * setting.sizes.patience + 5)
    start = open_capture(made.path).start + made.end - _BEFORE_THE_END
    found = medians(
        setting.sizes.rounds,
        {
            OURS: lambda: first_line(_seeking(made)) * 1e3,
            "small": lambda: first_line(_seeking(few)) * 1e3,
            "python alone": lambda: first_line(_PYTHON) * 1e3,
            "the mcap library's index alone": lambda: (
                timed(partial(peers.first_after, made.path, start)) * 1e3
            ),
        },
    )
    more = {f"ms with {few.frames / 1e6:.3g} M frames": found.pop("small")}
    return _row(work, f"{work.words}, {made.frames / 1e6:.3g} M frames", found, _SEEK, more)


def _row(
    work: Work, words: str, found: dict[str, float], most: float, more: dict[str, float]
) -> Row:
    """The row of a command that may take so many ms longer than Python alone."""
    over = found[OURS] - found["python alone"]
    goal = Goal(f"python + {most:g} ms", over, most, at_most=True)
    return work.row(words, "ms", found, goal, figures={"ms over python": over} | more)


def _seeking(made: Made) -> list[str]:
    return product.replayed(made.path, (made.end - _BEFORE_THE_END) / 1e9)


def start(setting: Setting, work: Work, *, words: list[str], over: float) -> Row:
    """A command to its first line, which may take so many ms longer than Python alone."""
    command = bilprov_words(*words)
    first_line(command)  # its files are compiled and cached now
    found = medians(
        setting.sizes.starts,
        {
            OURS: lambda: first_line(command) * 1e3,
            "python alone": lambda: first_line(_PYTHON) * 1e3,
        },
    )
    return _row(work, work.words, found, over, {})


help_page = partial(start, words=["--help"], over=60)
decoded = partial(start, words=["decode", "2111"], over=100)
