"""An exception in, one sentence on standard error and the exit code out: the one place for it."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import traceback

import click
from click import exceptions

# Exceptions whose text is a sentence for the user. They are looked up where they are already
# loaded: one that was raised is, and nothing is imported for the others.
SENTENCES = (
    ("spec.protocol", "GrammarError"),
    ("analyzer.transport.errors", "LinkError"),
    ("analyzer.output.filter", "FilterError"),
    ("captures.errors", "CaptureError"),
    ("conformance.dut.probes", "ProbeError"),
    ("conformance.dut.boards.emulator", "EmulatorError"),
    ("conformance.report.expected", "ExpectedError"),
    ("conformance.report.shard", "MergeError"),
)


def report(error: BaseException) -> int:
    """Say what went wrong, in one sentence on standard error, and give the exit code."""
    spoken = tuple(
        getattr(sys.modules[module], name) for module, name in SENTENCES if module in sys.modules
    )
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        _drop_output()
        return 130
    if isinstance(error, BrokenPipeError) and _reader_gone():
        _drop_output()
        return 0
    if isinstance(error, exceptions.NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
    elif isinstance(error, click.ClickException):
        _say(_usage(error))
    elif isinstance(error, spoken):
        _say(str(error))
    elif isinstance(error, OSError) and error.strerror:  # a full disk, no more descriptors
        _say(f"{error.filename}: {error.strerror}" if error.filename else error.strerror)
        _drop_output()
    else:
        traceback.print_exception(error)
        _say("this is a bug in bilprov, not in the device; please report it with the lines above")
    return 2


def _say(sentence: str) -> None:
    """One line, whatever was in it: foreign control and bidi characters become escapes."""
    line = " ".join(sentence.split())
    safe = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    click.echo(f"bilprov: {safe}", err=True)


# How click begins its own sentences; ours may begin with a name, which keeps its case.
_CLICK_BEGINS = ("Missing ", "No such ", "Invalid value", "Got unexpected ", "Option ", "Could not")


def _usage(error: click.ClickException) -> str:
    """Click's words as one sentence, with what to do next."""
    text = error.message if isinstance(error, _NO_SUCH) else error.format_message()
    text = " ".join(text.split()).rstrip(".")
    if text.startswith(_CLICK_BEGINS):
        text = text[0].lower() + text[1:]
    if isinstance(error, exceptions.NoSuchOption) and error.option_name == "--grammar":
        return f"{text} here: it goes before the subcommand, bilprov --grammar FILE.py ..."
    if isinstance(error, _NO_SUCH) and error.possibilities:
        return f"{text}, did you mean {error.possibilities[0]}?"
    if isinstance(error, click.UsageError) and error.ctx and "; see " not in text:
        return f"{text}; see {error.ctx.command_path} --help"
    return text


_NO_SUCH = (exceptions.NoSuchOption, exceptions.NoSuchCommand)


def _reader_gone() -> bool:
    """Whether whoever read our standard output has closed it."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    except (OSError, ValueError):
        return True


def _drop_output() -> None:
    """What is still buffered goes nowhere, so that the interpreter does not stumble at its end."""
    # Where there is no real standard output (a test that captures it) there is nothing to do.
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
