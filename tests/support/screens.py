"""The full screen in tests: over a made recording with Textual's pilot, and in a real tmux."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.feeds import Feed, Told
from bilprov.analyzer.screen.recording import Recording
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.spec.protocol import Protocol
from tests.support import ROOT

PATIENCE = 60.0  # s; a test that waits longer hangs
NO_TMUX = "apt-get install tmux"


def browser(
    protocol: Protocol, batches: Sequence[Batch], *, live: bool = False, **told: Any
) -> Browser:
    """The screen over a recording that is complete; `told` are fields of a Told."""

    def add(feed: Feed) -> None:
        for batch in batches:
            feed.recording.add(batch)

    feed = Feed(Recording(protocol), add, live=live, stays=True)
    return Browser(feed, Told("a test", 0, line_settings(protocol), **told))


@asynccontextmanager
async def operated(screen: Browser, size: tuple[int, int] = (120, 40)) -> AsyncIterator[Pilot[Any]]:
    """Show a screen with all its rows; gives what presses its keys."""
    async with screen.run_test(size=size) as pilot:
        screen.feed.join()
        screen.show_rows()
        await pilot.pause()
        yield pilot


def text_of(screen: Browser) -> list[str]:
    """The lines that the screen shows, as text."""
    width, height = screen.size
    lines = [" " * width for _ in range(height)]
    for y, strip in enumerate(screen.screen._compositor.render_strips()):
        lines[y] = "".join(segment.text for segment in strip)
    return lines


class Tmux:
    """A command in a real terminal of its own."""

    def __init__(self, socket: str) -> None:
        self._socket = socket

    def __call__(self, *words: str) -> str:
        done = subprocess.run(
            ["tmux", "-f", os.devnull, "-L", self._socket, *words],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
        )
        return done.stdout

    def lines(self, *options: str) -> list[str]:
        """What the terminal shows."""
        return self("capture-pane", "-p", *options).splitlines()

    def press(self, *keys: str) -> None:
        """Type keys, by tmux's names for them."""
        self("send-keys", *keys)

    def resize(self, size: tuple[int, int]) -> None:
        """Make the terminal another size."""
        self("resize-window", "-x", str(size[0]), "-y", str(size[1]))

    def wait(
        self, shows: str | Callable[[list[str]], bool], meanwhile: Callable[[], object] = bool
    ) -> list[str]:
        """Wait until the terminal shows the words, or lines that satisfy the test; its lines.

        What is done `meanwhile` is done before each further look.
        """
        give_up = time.monotonic() + PATIENCE
        while True:
            shown = self.lines()
            if any(shows in line for line in shown) if isinstance(shows, str) else shows(shown):
                return shown
            assert time.monotonic() < give_up, "\n".join(shown)
            meanwhile()
            time.sleep(0.05)


@contextmanager
def terminal(
    folder: Path, size: tuple[int, int], *arguments: str, **environment: str
) -> Iterator[Tmux]:
    """`bilprov` with these arguments in a tmux of this size, in a shell; skips without tmux.

    When the command has ended, the shell says `ended CODE` and takes lines like any shell.
    """
    if shutil.which("tmux") is None:
        pytest.skip(f"no tmux: {NO_TMUX}")
    socket = f"bilprov-{os.getpid()}-{time.monotonic_ns()}"
    script = folder / "run.sh"
    words = " ".join(f"'{word}'" for word in (sys.executable, "-m", "bilprov", *arguments))
    settings = {"PYTHONPATH": str(ROOT / "src"), "PS1": "shell> "} | environment
    exports = "".join(f"export {name}='{value}'\n" for name, value in settings.items())
    script.write_text(f"{exports}cd '{folder}'\n{words}\necho \"ended $?\"\nexec cat\n")
    tmux = Tmux(socket)
    columns, lines = size
    place = ["-x", str(columns), "-y", str(lines)]
    tmux("new-session", "-d", *place, f"sleep 0.2; exec sh '{script}'")
    tmux("set-option", "-g", "status", "off")  # else it has one of the lines
    tmux("resize-window", *place)
    try:
        yield tmux
    finally:
        tmux("kill-server")
