"""How fast the screen of `replay` is on the big capture: first page, keys, a filter, its memory.

As a program it looks through a capture with Textual's pilot, and prints the figures as JSON.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from pathlib import Path

from benchmarks import captures, product
from benchmarks.commands import run
from benchmarks.report import Goal, Row
from benchmarks.setting import Setting, Work

_KEYS = ("end", "pageup", "home", "pagedown", "n", "end", "N", "t")
_FILTER = "faulty and latency > 100us"


def browse(setting: Setting, work: Work) -> Row:
    """The screen over the big capture, in a process of its own."""
    made = captures.big(setting)
    patience = 40 * setting.sizes.patience + 20
    ended = run(
        [sys.executable, "-m", "benchmarks.browse", str(made.path), str(time.time())],
        keep=True,
        patience=patience,
    )
    found: dict[str, float] = json.loads(ended.output)
    memory = ended.memory / 1e6
    return Row(
        work.name,
        f"{work.words}, {2 * made.frames / 1e6:.3g} M rows",
        "s",
        found["first page"],
        figures={
            "s until all is read": found["all read"],
            "ms for the slowest key": found["key"] * 1e3,
            "s for a filter": found["filter"],
            "MB": memory,
        },
        goals=(
            Goal("first page in 1.5 s", found["first page"], 1.5, at_most=True),
            Goal("a key in 100 ms", found["key"] * 1e3, 100, at_most=True),
            Goal("a filter in 1 s", found["filter"], 1, at_most=True),
            Goal("500 MB", memory, 500, at_most=True),
        ),
    )


async def looked_through(path: Path, begun: float) -> dict[str, float]:
    """The times (s) it takes; `begun` is when the program was started (s since 1970)."""
    screen = product.browsing(path)
    recording, found = screen.feed.recording, {}
    async with screen.run_test(size=(120, 40)) as pilot:
        while not recording.rows:
            await pilot.pause(0.001)
        screen.show_rows()
        await pilot.pause()
        found["first page"] = time.time() - begun
        while not screen.feed.ended:
            await asyncio.sleep(0.05)
        screen.feed.join()
        found["all read"] = time.time() - begun
        keys = []
        for key in _KEYS:
            before = time.perf_counter()
            await pilot.press(key)
            keys.append(time.perf_counter() - before)
        found["key"] = max(keys)
        before = time.perf_counter()
        screen.action_filter()
        screen.prompt.line.value = _FILTER
        await pilot.press("enter")
        while screen.filter_text != _FILTER:
            await pilot.pause(0.01)
        found["filter"] = time.perf_counter() - before
    return found


if __name__ == "__main__":
    figures = asyncio.run(looked_through(Path(sys.argv[1]), float(sys.argv[2])))
    json.dump(figures, sys.stdout)
