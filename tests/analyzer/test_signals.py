"""Signals as requests to stop: what is taken back, and what stands."""

from __future__ import annotations

import select
import signal

from bilprov.analyzer.transport.signals import Stopper


def _asked(stopper: Stopper) -> bool:
    readable = bool(select.select([stopper], [], [], 0)[0])
    assert readable == stopper.stopped
    return readable


def test_a_stop_can_be_taken_back_and_asked_for_again() -> None:
    with Stopper() as stopper:
        assert not _asked(stopper)
        assert not stopper.withdraw(signal.SIGINT)
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            assert _asked(stopper)
            assert stopper.withdraw(signal.SIGINT)
            assert not _asked(stopper)


def test_a_stop_for_another_cause_stands() -> None:
    with Stopper() as stopper:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stopper.withdraw(signal.SIGINT)
        assert _asked(stopper)
        stopper.stop()
        assert stopper.withdraw(signal.SIGTERM)
        assert _asked(stopper)
