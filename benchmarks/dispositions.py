"""What the processes that tests and benchmarks start do with signals, however those were started.

A shell's background job ignores SIGINT and SIGQUIT, and what nohup starts ignores SIGHUP; both hand
that on to what they start, which would then not be ended by these signals.
"""

from __future__ import annotations

import signal
from types import FrameType

_PYTHONS_OWN = {signal.SIGPIPE, signal.SIGXFSZ}  # Python ignores these, and restores them itself


def usual_for_children() -> None:
    """Handle, by doing nothing, each signal that this process ignores: a handler is not inherited.

    So children start with the usual actions, and this process goes on ignoring.
    """
    for number in signal.valid_signals() - _PYTHONS_OWN:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, _nothing)


def _nothing(number: int, frame: FrameType | None) -> None:
    pass
