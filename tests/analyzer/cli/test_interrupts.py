"""A Ctrl-C that the interpreter would lose in a callback of its own is not lost."""

from __future__ import annotations

import signal
import sys
import weakref
from collections.abc import Iterator

import pytest

from bilprov.analyzer.cli.failures import interrupts_kept
from tests.support.commands import process


@pytest.fixture(autouse=True)
def _heeded() -> Iterator[None]:
    """SIGINT is heeded, also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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
def test_an_interrupt_in_a_callback_comes_again() -> None:
    def wait() -> None:
        lose(KeyboardInterrupt)
        for _ in range(1000):
            signal.sigtimedwait([], 0.01)

    with pytest.raises(KeyboardInterrupt), interrupts_kept():
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
