"""Reports exceptions of a command: one sentence on standard error, and the exit code.

A Ctrl-C that the interpreter would ignore is sent again, so that it is reported too.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator

import click
from click import exceptions

from bilprov.spec.errors import UserError, one_line


@contextlib.contextmanager
def interrupts_kept() -> Iterator[None]:
    """Send a SIGINT again whose KeyboardInterrupt was raised where no exception can go on.

    Such a place is a callback of the interpreter's own, as when an import ends: it prints
    "Exception ignored in" and goes on, and a robot would drive although Ctrl-C was pressed.
    """
    before = sys.unraisablehook

    def ignored(lost: sys.UnraisableHookArgs) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            before(lost)
            return
        # Not at once: it would be raised in here, and be lost again.
        while True:
            # On a busy machine it may come before its timer's thread is known to have started.
            with contextlib.suppress(KeyboardInterrupt):
                threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
                break

    sys.unraisablehook = ignored
    try:
        yield
    finally:
        sys.unraisablehook = before


def report(error: BaseException) -> int:
    """Print what went wrong, in one sentence on standard error, and return the exit code."""
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        # So that it does not wait for a slow reader. A test that captures output has no such file.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 130
    if isinstance(error, exceptions.NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
    elif isinstance(error, click.ClickException):
        say(_usage(error))
    elif isinstance(error, UserError):
        say(str(error))
    elif isinstance(error, MemoryError):
        say("memory ran out: close other programs, raise its limit (ulimit -v), or ask for less")
    elif isinstance(error, OSError) and error.strerror:  # a full disk
        say(f"{error.filename}: {error.strerror}" if error.filename else error.strerror)
    else:
        import traceback

        traceback.print_exception(error)
        say("this is a bug in bilprov, not in the device; please report it with the lines above")
    return 2


def say(sentence: str) -> None:
    """Print a sentence on standard error as one safe line of at most 4,000 characters."""
    click.echo(f"bilprov: {one_line(sentence)}", err=True)


# The beginnings of click's own sentences; ours may begin with a name, which keeps its case.
_CLICK_BEGINS = ("Missing ", "No such ", "Invalid value", "Got unexpected ", "Option ", "Could not")


def plain_words(text: str) -> str:
    """Convert what click says about a value to one line, in words for people who do not program."""
    line = " ".join(text.split()).rstrip(".")
    for kind, words in (("integer", "not a whole number"), ("float", "not a number")):
        line = re.sub(rf"is not a valid {kind}(?: range)?\b", f"is {words}", line)
    return line


def _usage(error: click.ClickException) -> str:
    """Convert click's message to one sentence that also says what to do next."""
    text = error.message if isinstance(error, _NO_SUCH) else error.format_message()
    text = plain_words(text)
    if isinstance(error, click.BadParameter) and error.ctx and error.param:
        from bilprov.analyzer.cli.settings import as_set, is_setting

        if is_setting(error.ctx, error.param.name):
            text = f"{text}, {as_set()}"
    if text.startswith(_CLICK_BEGINS):
        text = text[0].lower() + text[1:]
    if isinstance(error, _NO_SUCH) and error.possibilities:
        return f"{text}, did you mean {error.possibilities[0]}?"
    if isinstance(error, click.UsageError) and error.ctx and "; see " not in text:
        return f"{text}; see {error.ctx.command_path} --help"
    return text


_NO_SUCH = (exceptions.NoSuchOption, exceptions.NoSuchCommand)
