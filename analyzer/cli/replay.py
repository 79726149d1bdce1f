"""`bilprov replay`: shows a capture on a screen or in lines, and can send it to a device."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.options import (
    Finite,
    compiled,
    confirm_motion,
    filter_option,
    judge_option,
    line_options,
    max_drive_option,
    note,
    plain_option,
    row_options,
    row_style,
    session_format_option,
    session_style,
    timeout_option,
)
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.outputs import (
    Format,
    Shown,
    Window,
    opened_output,
)
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_parts import TEXT_BATCH, decoded
from bilprov.analyzer.replay.capture_session import (
    capture_decoder,
    capture_line,
    capture_timeout,
    heard,
    require_begun,
    said_about,
)
from bilprov.analyzer.replay.playback import interruptible, played
from bilprov.analyzer.replay.seek import Opened, opened_at
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.reader import Capture, open_capture, open_indexed
from bilprov.captures.schemas import MS, Chunk, Line, Look
from bilprov.captures.topics import HOST_RAW
from bilprov.spec.movement import movement_of, movement_words
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.monitor.passive_judge import PassiveJudge
    from bilprov.analyzer.output.row_columns import RowStyle


@click.command()
@click.argument("path", metavar="FILE.mcap")
@click.option(
    "--rate",
    type=Finite(0),
    default=1.0,
    show_default=True,
    help="How fast it is played: 1 as recorded, 2 twice as fast, 0 without pauses.",
)
@click.option("--start", type=Finite(0), help="Begin at this second of the capture.")
@click.option("--end", type=Finite(0), help="End before this second of the capture.")
@filter_option
@session_format_option
@row_options
@click.option("--count", type=click.IntRange(1), help="End after so many frames were shown.")
@click.option(
    "--duration",
    type=Finite(0, min_open=True),
    help="End after S seconds of the recording, counted from --start.",
)
@click.option(
    "--to",
    "port",
    metavar="PORT",
    type=PortName(),
    help="Also send the host's bytes to a device there and compare its answers.",
)
@plain_option
@judge_option
@click.option("--yes", is_flag=True, help="With --to: the device may move, do not ask.")
@max_drive_option
@line_options
@timeout_option
@click.pass_obj
def replay(
    grammar: str | None,
    path: str,
    rate: float,
    start: float | None,
    end: float | None,
    expression: str | None,
    style: Format | None,
    time_style: str | None,
    columns: str | None,
    count: int | None,
    duration: float | None,
    port: str | None,
    plain: bool,
    judged: bool,
    yes: bool,
    max_drive: float,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    truncation_timeout: float | None,
) -> int:
    """Look through a capture on a screen, or play it again.

    Examples:
      bilprov replay drive.mcap
      bilprov replay drive.mcap --plain --rate 0 --filter faulty
      bilprov replay drive.mcap --to /dev/ttyUSB0

    On a terminal a screen shows all of it: frames, their fields and bits, faults, the predicted
    state. Space plays from the selected row at the recorded pace, times --rate, and stops again; ?
    lists the keys. Nothing is written except what you export with x.

    With --plain, --format, --judge or --to, and in a pipe, the capture is played in lines, with its
    recorded timing. It is decoded from its raw bytes, and shown as `sniff` would have shown it.

    With --to the host's bytes between --start and --end go to a device too, with their recorded
    timing (at --rate 0 each frame when the one before is answered), and every answer that differs
    from the recorded one is reported: exit code 1 if there is any, 3 if the recording holds no
    answers. It is also 1 if the device does not answer the stops at the end.

    With --judge the recorded device is judged: a table at the end (with --format jsonl a last
    object of kind judgement) shows which parts of the document the traffic covered and what
    contradicts it; exit code 1 if anything does, 2 if not all of it could be shown.
    """
    if judged and port is not None:
        raise click.UsageError("--judge judges the recorded device; for one at --to, use sniff")
    if count is not None and port is not None:
        raise click.UsageError("--count counts the frames shown; with --to, --duration ends it")
    if judged:
        promise_verdict()
    if start is not None and end is not None and end <= start:
        raise click.UsageError(f"--end {end:g} is not after --start {start:g}")
    protocol = load_protocol(grammar)
    in_lines = "--to" if port is not None else "--judge" if judged else ""
    if in_lines and style == "live":
        raise click.UsageError(f"{in_lines} is shown in lines: leave out --format live")
    style = session_style(style, plain or (style is None and bool(in_lines)))
    rows = row_style(time_style, columns, protocol, style)
    test = compiled(expression, protocol)
    timeout = None if truncation_timeout is None else round(truncation_timeout * MS)
    window = _window(start, end, duration)
    opened = _opened(path, protocol, timeout, window, style, whole=bool(in_lines))
    capture = opened.capture
    test = test and test.started(capture.start)
    require_begun(capture, window.first)
    if style == "live":
        _look_through(opened, protocol, rows, expression, test, count, window, rate)
        return 0
    for sentence in (*said_about(capture, protocol), opened.note):
        if sentence:
            note(sentence)
    if port is not None:
        if not capture.contents.counts.get(HOST_RAW):
            raise click.UsageError(f"{path} holds no bytes of the host to send")
        # Before Ctrl-C is taken over, so that it can end the question.
        if not yes:  # what moves is in the whole capture
            what = _what_moves(protocol, port, path, capture, timeout, window)
            confirm_motion(protocol, what, yes=False)
    with ExitStack() as stack:
        stopper = stack.enter_context(Stopper())
        target, sent = None, 0
        if port is not None:
            from bilprov.analyzer.cli.resend import opened_target, send_again
            from bilprov.analyzer.replay.comparison import ReplayRun

            settings = line_settings(protocol, baud, parity, stopbits)
            pause = capture_timeout(capture, protocol, timeout)
            run = ReplayRun()
            target = stack.enter_context(
                opened_target(protocol, port, settings, pause, rate, stopper, run, max_drive)
            )
        judge = None
        if judged:
            from bilprov.analyzer.monitor.passive_judge import PassiveJudge

            attached = capture.metadata.get("attached") != "no"
            judge = PassiveJudge(protocol, paired=heard(capture) >= BOTH, attached=attached)
        output = opened_output(style, protocol, rows, capture.start)
        shown = Shown(output, test, count, window)
        pipeline = Pipeline(opened.decoder, Statistics(), shown, judge=judge)
        if target is not None:
            sent = send_again(
                protocol, capture, pipeline, output, target, run, rate, window, stopper
            )
        else:
            if rate or judge:
                events = capture.sights() if judge else opened.events()
                _play(events, pipeline, rate, window, stopper, judge)
            else:
                _show(opened, shown, window, stopper)
    if target is not None and not target.answered_stops:
        from bilprov.analyzer.replay.answers import UNANSWERED_STOPS

        note(UNANSWERED_STOPS)
        return sent or 1
    if target is not None:
        return sent
    if judge is None:
        return 0
    from bilprov.analyzer.output.findings import tell_findings

    return tell_findings(judge.finish(), style)


def _what_moves(
    protocol: Protocol, port: str, path: str, capture: Capture, timeout: int | None, window: Window
) -> str:
    """What the host bytes of the window will make the device at the port do, in words."""
    decoder = capture_decoder(capture, protocol, timeout)

    def frames() -> Iterator[bytes]:
        inside = (event for event in capture.events() if window.has(event.t))
        parts = map(decoder.feed, ([event] for event in inside))
        for batch in chain(chain.from_iterable(parts), decoder.finish()):
            yield from (r.data for r in batch.records() if isinstance(r, HostRecord))

    words = movement_words(protocol, movement_of(protocol, frames()))
    return f"the device at {port} will move as recorded in {path}: {words}"


def _window(start: float | None, end: float | None, duration: float | None) -> Window:
    """The window of time (s) that is shown: up to `end` or for the duration, whichever is first."""
    ends = [end] if end is not None else []
    if duration is not None:
        ends.append((start or 0) + duration)
    first, after = (None if s is None else round(s * 1e9) for s in (start, min(ends, default=None)))
    return Window(first, after)


def _opened(
    path: str,
    protocol: Protocol,
    timeout: int | None,
    window: Window,
    style: Format,
    *,
    whole: bool,
) -> Opened:
    """Open the capture; not from its beginning on if `whole` is false and the window is later.

    For the screen its index is enough, so that the first rows are there at once.
    """
    if window.first is not None and not whole:
        return opened_at(path, protocol, window.first, timeout)
    capture = (open_indexed(path) if style == "live" else None) or open_capture(path)
    return Opened(capture, capture_decoder(capture, protocol, timeout))


def _look_through(
    opened: Opened,
    protocol: Protocol,
    rows: RowStyle,
    expression: str | None,
    test: Filter | None,
    count: int | None,
    window: Window,
    rate: float,
) -> None:
    """Show the capture on the screen until it is left."""
    from bilprov.analyzer.screen.browser import Told
    from bilprov.analyzer.screen.feeds import capture_feed
    from bilprov.analyzer.screen.terminal import shown

    capture = opened.capture
    feed = capture_feed(opened, protocol, test, count, window)
    # The screen has one line for it, so the file's name stands without its folder.
    named = replace(capture, path=Path(capture.path.name))
    sentences = (*said_about(named, protocol), opened.note)
    feed.notice = "; ".join(filter(None, sentences))
    told = Told(
        capture.path.name,
        capture.start,
        capture_line(capture, protocol).byte_time,
        rows,
        expression or "",
        test,
        rate,
    )
    with Stopper() as stopper:
        shown(feed, told, stopper)
        feed.join()


def _show(opened: Opened, shown: Shown, window: Window, stopper: Stopper) -> None:
    """Show what is decoded of the window, as fast as it goes."""
    for batch in decoded(opened.decoder, opened.batches(), window=window, largest=TEXT_BATCH):
        if stopper.stopped or shown.full:
            return
        shown.show(batch)


def _play(
    events: Iterable[Chunk | Line | Look],
    pipeline: Pipeline,
    rate: float,
    window: Window,
    stopper: Stopper,
    judge: PassiveJudge | None,
) -> None:
    now = 0
    # Between two events, time passes as it did in the recording.
    sleep = interruptible(stopper, lambda slept: pipeline.advance(now + int(slept * rate * 1e9)))
    playing = played(events, rate, sleep=sleep, start=window.first, end=window.after)
    for event in playing:
        if stopper.stopped or pipeline.shown.full:
            return
        now = event.t
        if not isinstance(event, Look):
            pipeline.events([event])
        pipeline.advance(now)
        if judge and isinstance(event, Look) and window.has(now):
            judge.look(event)
    pipeline.finish()
