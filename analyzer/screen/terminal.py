"""Shows the screen on the terminal that standard output is, whatever its encoding."""

from __future__ import annotations

import os
import sys
import termios
from contextlib import suppress
from typing import Any

from textual.drivers.linux_driver import LinuxDriver

from bilprov.analyzer.output.console import NARROW
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.feeds import Feed, Told
from bilprov.analyzer.transport.signals import Stopper

_SWITCH = 0.00005  # s after which a thread yields to the reader of a line (Python: 5 ms)


class TerminalDriver(LinuxDriver):
    """Draws on standard output, where results belong; Textual itself draws on standard error.

    When the screen closes, keys that were typed and not used are thrown away: none of them reaches
    the shell.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        assert sys.__stdout__ is not None
        self._file: Any = _Terminal(sys.__stdout__.fileno(), sys.__stdout__.encoding)

    def stop_application_mode(self) -> None:
        """Give the terminal back as it was."""
        super().stop_application_mode()
        with suppress(termios.error):
            termios.tcflush(self.fileno, termios.TCIFLUSH)


class _Terminal:
    """Where text is drawn. Signs that its encoding lacks are ASCII, other text a question mark.

    Once the terminal is gone, nothing is drawn: the session ends in order all the same.
    """

    def __init__(self, descriptor: int, encoding: str) -> None:
        self._descriptor = descriptor
        self._encoding = encoding

    def write(self, text: str) -> None:
        """Write text at once."""
        data = memoryview(text.encode(self._encoding, NARROW))
        with suppress(OSError):
            while data:
                data = data[os.write(self._descriptor, data) :]

    def flush(self) -> None:
        """Nothing is held."""

    def fileno(self) -> int:
        """The descriptor."""
        return self._descriptor


def shown(feed: Feed, told: Told, stopper: Stopper) -> str | None:
    """Show a feed on the terminal until the screen is left, or until the stopper stops it.

    Returns the name of the file to keep the recording in, None for none. The feed has been told to
    end then. Raises what made the screen fail, if anything did: then the feed goes on.
    """
    for name in ("COLUMNS", "LINES"):  # Textual believes them, and they do not change
        os.environ.pop(name, None)
    browser = Browser(feed, told, lambda: stopper.stopped, TerminalDriver)
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH)
    try:
        kept = browser.run()
    finally:
        sys.setswitchinterval(before)
    if browser.failure and not stopper.stopped:
        raise browser.failure
    feed.stop()
    return kept
