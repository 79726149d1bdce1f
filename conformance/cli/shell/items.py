"""Has a device do the items of `bilprov send`, or what is typed or piped, and shows its answers.

Its probe is opened, and it is asked once whether the device may move. A probe looks at the robot
after each item.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial

import click

from bilprov.analyzer.cli.options import (
    confirm_effect,
    note,
    note_hindrances,
    note_suspension,
    require_reading,
)
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.cli.typed_input import bytes_or_pause, meant
from bilprov.analyzer.client.probes import NONE, Probe, open_probe
from bilprov.analyzer.decode.records import HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.output.outputs import opened_output, write_out
from bilprov.analyzer.replay.comparison import (
    FLOOD_WORDS,
    UNANSWERED_STOPS,
    AnswerCheck,
    Exchanges,
    first_difference,
)
from bilprov.analyzer.replay.target import Target
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.analyzer.transport.replug import Place, opened_again, opened_when_there
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Chunk
from bilprov.captures.text import quantity
from bilprov.conformance.cli.shell.driving import STEP, Driving, asked, look_text
from bilprov.conformance.cli.shell.options import SendOptions
from bilprov.spec.by_effect import effect_words
from bilprov.spec.errors import UserError
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import PLAIN_ANSWER, Protocol

_NO_ANSWER = "none"


def send_items(
    protocol: Protocol, options: SendOptions, settings: LineSettings, timeout: int
) -> int:
    """Send the items of the options to their port, show the answers, and return the exit code.

    `timeout` (ns) is the longest pause inside a frame. Raises UsageError for an item that is
    nothing, LinkError for a port that cannot be used, ProbeError for a probe that cannot.
    """
    port, wait, together = options.target, options.wait, options.together
    style, expectations = options.style, options.expectations
    try:
        steps = [bytes_or_pause(protocol, item) for item in options.items]
        expected = [_code(protocol, word) for text in expectations for word in text.split(",")]
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    frames = _frames(protocol, steps, timeout, together=together)
    if options.only_reading:
        require_reading(protocol, frames)
    planned = len(frames)
    if expectations:
        promise_verdict()
        if len(expected) != planned:
            raise click.UsageError(
                f"--expect names {len(expected)} and {planned} should be answered: name one for "
                f"each instruction, {_NO_ANSWER} where no answer should come"
            )
    output, run, check = opened_output(style, protocol), Exchanges(), AnswerCheck()
    opened = _opened(port, settings, wait=wait)
    if opened is None:
        note("stopped before the port appeared: nothing was sent")
        return 1
    words = effect_words(protocol, frames)
    with agreed(protocol, options, opened, "what is sent", words) as (eye, stopper):

        def heard(record: Record) -> None:
            if run.flooded:
                return
            check.record(record)
            run.record(record)
            output.records([record])
            if run.flooded:
                stopper.stop()

        def done(what: bytes | float) -> None:
            if isinstance(what, float):
                target.wait(what)
                return
            target.send(what)
            if not together:
                target.settle()

        def look() -> None:
            """After the last answer that is waited for, as long as the robot is let be."""
            if together:
                target.settle()
            if eye is None or target.ended:
                return
            seen = asked(eye, target.pump, stopper, target.now)
            if seen is not None:
                write_out(look_text(seen, style))

        place, gaps = Place(port), list[str]()
        with Target(protocol, opened, timeout, stopper, heard, options.max_drive) as target:
            target.begin(homed=not options.unhomed)
            actions: list[Callable[[], object]] = []
            for what in steps:
                actions += [partial(done, what)] + [look] * (not together)
            actions += [look] * together
            # With --wait it is homed while a port that is lost can still be waited for.
            for action in (*actions, target.finish, *([target.home] * wait)):
                if stopper.stopped or target.driven_out:
                    break
                try:
                    action()
                except LinkError as lost:
                    if not wait:
                        raise
                    gaps.append(_resumed(target, place, settings, stopper, lost))
    told = [*gaps, target.driven_out_words]
    told.append(FLOOD_WORDS if run.flooded else check.unasked_words)
    if expectations:
        told.append(first_difference(protocol, run, expected))
    else:
        told += [check.wrong_words, check.missing_words]
    if check.sent < planned:
        told.append(f"{check.sent} of {quantity(planned, 'instruction')} were sent")
    elif stopper.stopped and not run.flooded:
        told.append("stopped before the end")
    if not target.answered_stops:
        told.append(UNANSWERED_STOPS)
    note(*told)
    return 1 if any(told) else 0


def _opened(port: str, settings: LineSettings, *, wait: bool) -> Port | None:
    """Open the port; with `wait`, once it is there. None if stopped before. Raises LinkError."""
    if not wait:
        return open_port(port, settings)
    with Stopper() as stopper:
        return opened_when_there(partial(open_port, port, settings), lambda: stopper.stopped, note)


def _resumed(
    target: Target, place: Place, settings: LineSettings, stopper: Stopper, lost: LinkError
) -> str:
    """Wait for the port that was lost, and home the robot there; returns what was, in words.

    Raises LinkError where the port cannot be found again, a stop was asked for before it was, or
    nobody answers there.
    """
    while place.lasts:
        note(f"{lost}; waiting")
        port = opened_again(place, settings, lost, lambda: stopper.stopped)
        if port is None:
            break
        gap = f"{port.name} was lost and is there again, and the robot was stopped there first"
        try:
            target.resume(port, gap)
        except LinkError as again:
            lost = again
            continue
        target.require_answer()
        return gap
    raise lost


def _code(protocol: Protocol, word: str) -> int | None:
    """Parse an expected answer into its code, None for no answer. Raises ValueError."""
    word = word.strip()
    known = [*protocol.responses]
    if protocol.answers[Outcome.VALID] is PLAIN_ANSWER:
        known.append(PLAIN_ANSWER)
    codes = {spec.name.lower(): spec.code for spec in known}
    if word.lower() in codes:
        return codes[word.lower()]
    if word.lower() == _NO_ANSWER:
        return None
    with suppress(ValueError):
        number = int(word, 0)
        if number in range(256):
            return number
    names = [*(spec.name for spec in known), _NO_ANSWER]
    raise ValueError(
        f"--expect {word!r} is not an answer{meant(word, names)}; there are {', '.join(names)} "
        "and the numbers 0 to 255"
    )


def _frames(
    protocol: Protocol, steps: Sequence[bytes | float], timeout: int, *, together: bool
) -> list[bytes]:
    """The instructions that the steps hold, whole ones and those that the time-out cuts short."""
    session = Session(protocol, timeout=timeout, heard=frozenset({"host"}))
    records: list[Record] = []
    now = 0
    for what in steps:
        if isinstance(what, float):
            now += round(what * 1e9)
            continue
        records += session.feed(Chunk(now, "host", what))
        if not together:  # a frame that is incomplete is waited for
            now += timeout
    records += session.finish()
    hosts = (record for record in records if isinstance(record, HostRecord))
    return [record.data for record in hosts if record.sequence is not None]


def drive(protocol: Protocol, options: SendOptions, settings: LineSettings, timeout: int) -> int:
    """Have what is typed done by the device at a port, until the end; returns the exit code.

    `timeout` (ns) is the longest pause inside a frame. Raises LinkError and ProbeError.
    """
    words = "" if options.only_reading else effect_words(protocol)
    opened = open_port(options.target, settings)
    with (
        agreed(protocol, options, opened, "what is typed", words) as (eye, stopper),
        Driving(protocol, options, opened, timeout, stopper, eye) as driving,
    ):
        driving.begin()
        dumb = os.environ.get("TERM") == "dumb"
        interactive = sys.stdin.isatty() and sys.stdout.isatty() and not dumb
        if interactive:
            from bilprov.conformance.cli.shell.prompt import Prompt

            Prompt(protocol, driving, stopper).run()
        else:
            done = do_lines(driving, stopper)
            driving.target.finish()
    told = [] if driving.target.answered_stops else [UNANSWERED_STOPS]
    if not interactive:
        check = driving.check
        told += filter(None, (check.unasked_words, check.wrong_words, check.missing_words))
    note(*told)
    return 1 if told or not (interactive or done) else 0


@contextmanager
def agreed(
    protocol: Protocol, options: SendOptions, port: Port, what: str, words: str
) -> Iterator[tuple[Probe | None, Stopper]]:
    """Open the probe of the robot at a port and ask once whether the robot may move.

    `what` it will do and what that may change are in words. Gives the probe, None for none, and the
    stopper that handles signals until the end of the block, which closes all. Raises ProbeError.
    """
    with ExitStack() as stack:
        stack.enter_context(port)
        eye = open_probe(options.probe or NONE, port, protocol)
        if eye is not None:
            stack.callback(eye.close)
        note_hindrances(options.target)
        what = f"the {protocol.device} at {options.target} will do {what}"
        confirm_effect(protocol, what, words, yes=options.yes)
        stopper = stack.enter_context(Stopper())
        yield eye, stopper
        note_suspension(stopper)


_PIECE = 1 << 12  # bytes
_LONGEST = 1 << 16  # bytes of a line


class ScriptError(UserError):
    """A line that cannot be done; the message names it and says why."""


def do_lines(driving: Driving, stopper: Stopper) -> bool:
    """Do the lines of standard input until its end, `quit`, or a signal.

    Returns whether each line was done to its end. Raises ScriptError for a mistake, LinkError and
    ProbeError.
    """
    done = True
    for number, line in enumerate(_lines(driving, stopper), start=1):
        try:
            done &= driving.do(line.decode(errors="backslashreplace"))
        except ValueError as error:
            if not sys.stdin.isatty():
                raise ScriptError(f"line {number}: {error}") from error
            note(f"{error}; see help")  # typed by somebody who can type it again
        if driving.over:
            break
    return done


def _lines(driving: Driving, stopper: Stopper) -> Iterator[bytes]:
    """Yield lines as they come; meanwhile the robot is attended to."""
    descriptor = sys.stdin.fileno()
    held = b""
    while not stopper.stopped:
        if not driving.attend(STEP, [descriptor]):
            continue
        data = os.read(descriptor, _PIECE)
        *lines, held = (held + data).split(b"\n")
        if not data and held:
            lines, held = [held], b""
        for line in lines:
            if stopper.stopped:
                return
            yield line
        if not data:
            return
        if len(held) > _LONGEST:
            raise ScriptError(f"a line is longer than {_LONGEST} bytes; end lines with a newline")
