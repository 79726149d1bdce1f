"""A relay before a robot's line: counts, holds back answers, reads slowly, is unplugged.

It is a pty under a path that stays the same, as a USB adapter is.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from bilprov.analyzer.transport.port import open_port, open_pty

_SLOW = 0.01  # s that a byte takes whose reader is slow
_DRAINED = 0.06  # s without a byte, after which none is on its way


class Plug:
    """A port under a path that stays the same."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.plug()

    def plug(self) -> None:
        """Plug it in."""
        self.pair = open_pty()
        self.path.symlink_to(self.pair.name)

    def pull(self) -> None:
        """Unplug it."""
        self.pair.close()
        self.path.unlink(missing_ok=True)


class Adapter(AbstractContextManager["Adapter"]):
    """A USB adapter at a robot's line, under the path `link`, that is unplugged now and then.

    It is unplugged each time that so many more bytes of the host have passed as `after` says next,
    and plugged in again `away` s later; None: never again. With `late` it is unplugged so much (s)
    after these bytes, and what comes meanwhile passes.
    """

    def __init__(
        self,
        link: Path,
        line: str,
        after: Sequence[int] = (),
        away: float | None = None,
        late: float = 0.0,
    ) -> None:
        self._plug, self._line = Plug(link), open_port(line)
        self._away, self._late = away, late
        self.unplugged = threading.Event()
        """Whether it has been unplugged."""
        self.plugged_again = threading.Event()
        """Whether it has been plugged in again."""
        self.passed = 0
        """Bytes of the host that it has handed on."""
        self.last = time.monotonic()
        """When the last byte passed (s)."""
        self.withheld = self.slow = False
        """Whether answers are held back, and whether the host's bytes are taken one by one."""
        self._after = list(after)
        self._over = threading.Event()
        self._wait_for_bytes()
        self._thread = threading.Thread(target=self._relay)
        self._thread.start()

    def _wait_for_bytes(self) -> None:
        self._left = self._after.pop(0) if self._after else None
        self._due: float | None = None  # when it is unplugged, once its bytes have passed

    def _relay(self) -> None:
        while not self._over.is_set():
            ready = select.select([self._line.fileno(), self._plug.pair.master], [], [], 0.01)[0]
            said = self._taken() if self._plug.pair.master in ready else b""
            handed = said if self._left is None or self._late else said[: self._left]
            self._line.write(handed)
            self.passed += len(handed)
            heard = self._line.read()
            self._plug.pair.write_some(b"" if self.withheld else heard)
            if said or heard:
                self.last = time.monotonic()
            if self._left is None:
                continue
            self._left -= len(said)
            if self._left <= 0 and self._due is None:
                self._due = time.monotonic() + self._late
            if self._due is not None and time.monotonic() >= self._due:
                self._plug.pull()
                self.unplugged.set()
                if self._over.wait(self._away) or self._away is None:
                    return
                self._plug.plug()
                self._wait_for_bytes()
                self.plugged_again.set()

    def _taken(self) -> bytes:
        if not self.slow:
            return self._plug.pair.read()
        time.sleep(_SLOW)
        return os.read(self._plug.pair.master, 1)

    @property
    def quiet(self) -> float:
        """For how long (s) no byte has passed."""
        return time.monotonic() - self.last

    def drained(self) -> None:
        """Wait until all that the host has sent has arrived."""
        while select.select([self._plug.pair.master], [], [], 0)[0] or self.quiet < _DRAINED:
            time.sleep(0.01)

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._plug.pull()
        self._line.close()
