"""Signals as requests to stop: what is taken back, and what stands."""

from __future__ import annotations

import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from bilprov.analyzer.transport.signals import (
    ENDINGS,
    SUSPENDING,
    Stopper,
    exit_status,
    handled_from_now_on,
    unhandled,
)
from tests.support.signals import handled


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    """A test that ends early leaves no signal for a command that a later test runs here."""
    yield
    exit_status(0)


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


@pytest.mark.parametrize("number", ENDINGS)
def test_each_signal_that_ends_a_process_asks_for_a_stop(number: int) -> None:
    usual = number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    with handled(signal.SIG_DFL, number), Stopper() as stopper:
        signal.raise_signal(number)
        assert _asked(stopper)

    assert exit_status(3) == (3 if usual else 128 + number)
    assert exit_status(3) == 3


ASK_EACH = """\
import os, signal
from bilprov.analyzer.transport.signals import ENDINGS
for number in range(1, signal.NSIG):
    if signal.getsignal(number) is not signal.SIG_DFL or number in ENDINGS:
        continue
    child = os.fork()
    if not child:
        signal.raise_signal(number)
        os._exit(0)
    _, status = os.waitpid(child, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(child, signal.SIGKILL)
    elif os.WIFSIGNALED(status):
        print(signal.Signals(number).name)
"""


def test_the_signals_that_end_a_process_and_are_not_handled_are_those_of_a_crash() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", ASK_EACH], stdout=subprocess.PIPE, check=True, text=True
    )

    crashes = {"SIGILL", "SIGTRAP", "SIGABRT", "SIGBUS", "SIGFPE", "SIGSEGV", "SIGSYS"}
    assert set(ran.stdout.split()) == crashes | {"SIGKILL"}


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1])
def test_a_signal_that_is_ignored_stays_ignored(number: signal.Signals) -> None:
    with handled(signal.SIG_IGN, number), Stopper() as stopper:
        assert unhandled([number]) == []
        signal.raise_signal(number)
        assert not _asked(stopper)


def test_postponed_signals_come_to_the_programs_own_handler_and_only_afterwards() -> None:
    heard: list[int] = []
    with handled(lambda number, frame: heard.append(number), signal.SIGTERM):
        with Stopper() as postponed:
            for _ in range(2):
                signal.raise_signal(signal.SIGTERM)
            assert heard == []
        postponed.pass_on()

    assert heard == [signal.SIGTERM]


def test_asyncio_finds_its_signal_as_it_was() -> None:
    def heard(number: int, frame: object) -> None:
        pass

    with ExitStack() as stack:
        for number in (*ENDINGS, *SUSPENDING):
            stack.enter_context(handled(signal.SIG_DFL, number))
        stack.enter_context(handled(signal.default_int_handler, signal.SIGINT))
        handled_from_now_on(heard)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.getsignal(signal.SIGTERM) is heard
        assert unhandled([signal.SIGTERM]) == [signal.SIGTERM]


def test_a_stop_for_another_cause_stands() -> None:
    with Stopper() as stopper:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert stopper.withdraw(signal.SIGINT)
        assert _asked(stopper)
        stopper.stop()
        assert stopper.withdraw(signal.SIGTERM)
        assert _asked(stopper)
