"""Signals as requests to stop: what is taken back, and what stands."""

from __future__ import annotations

import select
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import ExitStack
from unittest.mock import DEFAULT, patch

import pytest

from bilprov.analyzer.transport.signals import (
    ENDINGS,
    SUSPENDING,
    Stopper,
    exit_status,
    handled,
    handled_from_now_on,
    interrupts_kept,
    unhandled,
)
from tests.support.commands import process


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
    with handled([number], signal.SIG_DFL), Stopper() as stopper:
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
    with handled([number], signal.SIG_IGN), Stopper() as stopper:
        assert unhandled([number]) == []
        signal.raise_signal(number)
        assert not _asked(stopper)


def test_postponed_signals_come_to_the_programs_own_handler_and_only_afterwards() -> None:
    heard: list[int] = []
    with handled([signal.SIGTERM], lambda number, frame: heard.append(number)):
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
            stack.enter_context(handled([number], signal.SIG_DFL))
        stack.enter_context(handled([signal.SIGINT], signal.default_int_handler))
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


# -- interrupts that the interpreter would lose ----------------------------------------------------


class Module:
    """Something that is collected."""


def lose(error: type[BaseException]) -> None:
    """Raise an exception where the interpreter can only ignore it."""

    def ended(_: object) -> None:
        raise error

    held = Module()
    watch = weakref.ref(held, ended)
    del held
    assert watch() is None


@pytest.mark.waits
@pytest.mark.parametrize("lost", [0, 1])
def test_an_interrupt_in_a_callback_comes_again(lost: int) -> None:
    """Also where, on a busy machine, it comes before whoever starts the timer goes on."""
    timers = [KeyboardInterrupt] * lost + [DEFAULT]

    def wait() -> None:
        lose(KeyboardInterrupt)
        for _ in range(1000):
            signal.sigtimedwait([], 0.01)

    with (
        patch.object(threading, "Timer", wraps=threading.Timer, side_effect=timers),
        handled([signal.SIGINT], signal.default_int_handler),
        pytest.raises(KeyboardInterrupt),
        interrupts_kept(),
    ):
        wait()


def test_other_exceptions_are_told_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda lost: told.append(lost.exc_type))

    with interrupts_kept():
        lose(ValueError)
    lose(KeyError)

    assert told == [ValueError, KeyError]


@pytest.mark.waits
def test_a_command_that_lost_one_while_it_imports_ends() -> None:
    code = """
import signal, sys, weakref
from bilprov import __main__ as front_door

signal.signal(signal.SIGINT, signal.default_int_handler)

class Module: pass

def interrupted(_):
    raise KeyboardInterrupt

run = front_door._run

def importing(arguments):
    held = Module()
    watch = weakref.ref(held, interrupted)
    del held
    return run(arguments)

front_door._run = importing
front_door.main(["simulate"])
"""

    done = process(code=code)

    assert done.returncode in (0, 130)
    assert b"ignored" not in done.stderr
