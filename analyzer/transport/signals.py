"""Ctrl-C, SIGTERM and a closed terminal as something a select loop can wait for."""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self


class Stopper:
    """Turns SIGINT, SIGTERM and SIGHUP into a clean stop: `fileno()` is readable from then on.

    As a context manager it takes the three signals over (in the main thread; elsewhere it only
    offers `stop`) and puts the old handlers back at the end. A second signal changes nothing, so
    that a command can finish its file in peace; SIGQUIT (Ctrl-\\) still ends the process at once.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._stopped = False
        self._old: dict[signal.Signals, Any] = {}
        self._old_wakeup: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether a stop was asked for."""
        return self._stopped

    def fileno(self) -> int:
        """Return the descriptor that is readable once a stop was asked for."""
        return self._reader.fileno()

    def stop(self) -> None:
        """Ask for a stop, from any thread or signal handler; more than once is as good as once."""
        if not self._stopped:
            self._stopped = True
            with contextlib.suppress(OSError):  # closed already: nobody waits any more
                self._writer.send(b"\0")

    def close(self) -> None:
        """Put the old handlers back and close; more than once is as good as once."""
        if self._old_wakeup is not None:
            try:
                signal.set_wakeup_fd(self._old_wakeup)
            except OSError:  # the one before us closed before us
                signal.set_wakeup_fd(-1)
            self._old_wakeup = None
        while self._old:
            number, handler = self._old.popitem()
            signal.signal(number, handler)
        self._reader.close()
        self._writer.close()

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                # None is a handler that was not set from Python and cannot be put back from here.
                if signal.getsignal(number) is not None:
                    self._old[number] = signal.signal(number, self._on_signal)
            # A signal between the interpreter's own check and the select call would be heard only
            # at the next event: its number is written below Python, and ends the select.
            self._old_wakeup = signal.set_wakeup_fd(
                self._writer.fileno(), warn_on_full_buffer=False
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.stop()


@contextmanager
def undisturbed(*, again: bool) -> Iterator[None]:
    """Ctrl-C and the like are heard only afterwards, if `again`: the robot is stopped first."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[int] = []
    before: dict[int, Any] = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not None:  # else it cannot be put back from here
            before[number] = signal.signal(number, lambda got, frame: heard.append(got))
    try:
        yield
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)
    if heard and again:
        signal.raise_signal(heard[0])


@contextmanager
def ending_in_order() -> Iterator[None]:
    """SIGTERM and SIGHUP, where nobody heeds them, end the block by SystemExit instead of at once.

    So what the block has to leave behind is done, as it is after Ctrl-C. Without effect outside of
    the main thread.
    """
    old: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:
                old[number] = signal.signal(number, _exit)
    try:
        yield
    finally:
        while old:
            signal.signal(*old.popitem())


def _exit(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
