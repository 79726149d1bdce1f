"""The signals that end a process and can be handled, and which of them ended this command."""

from __future__ import annotations

import signal

REQUESTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The usual requests to end: a command that they end has an exit code of its own for that."""


def _endings() -> tuple[int, ...]:
    names = "SIGQUIT SIGUSR1 SIGUSR2 SIGALRM SIGVTALRM SIGPROF SIGXCPU SIGIO SIGPWR SIGSTKFLT"
    others = [getattr(signal, name) for name in names.split() if hasattr(signal, name)]
    first = getattr(signal, "SIGRTMIN", 0)
    realtime = range(first, signal.SIGRTMAX + 1) if first else ()
    return (*REQUESTS, *others, *realtime)


ENDINGS = _endings()
"""Every signal that ends a process unless it is handled.

SIGKILL cannot be handled. SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGSYS and SIGTRAP are how a
process crashes: no Python can run after them. Python ignores SIGPIPE and SIGXFSZ.
"""

SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""Signals that suspend a process unless it is handled: Ctrl-Z, and the use of the terminal by a job
in the background. SIGSTOP cannot be handled."""

_heard: list[int] = []


def note_ending(number: int) -> None:
    """Remember that this signal has asked the command to end."""
    _heard.append(number)


def ending_requested() -> bool:
    """Whether a signal has asked the command to end, also one that was put off and is over."""
    return bool(_heard)


def exit_status(status: int) -> int:
    """The exit code of the command that has ended with `status`.

    It is 128 + N where a signal N other than SIGINT, SIGTERM and SIGHUP ended it.
    """
    others = [number for number in _heard if number not in REQUESTS]
    _heard.clear()
    return 128 + others[0] if others else status
