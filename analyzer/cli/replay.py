"""`bilprov replay`: shows a capture on a screen or in lines, and can send it to a device."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bilprov.analyzer.cli.command import argument, command, flag, group, option
from bilprov.analyzer.cli.options import (
    Finite,
    SendingLineOptions,
    ShownOptions,
    WindowOptions,
    compiled,
    confirm_effect,
    half_duplex_option,
    judge_option,
    max_drive_option,
    note,
    note_each,
    only_reading_option,
    plain_option,
    require_reading,
    timeout_option,
)
from bilprov.analyzer.cli.reading import protocol_of, split
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.output.outputs import Format, Shown, Window, opened_output
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_decoding import (
    TEXT_BATCH,
    Opened,
    capture_decoder,
    capture_line,
    capture_timeout,
    decoded,
    heard,
    interruptible,
    opened_at,
    paced,
    require_begun,
    said_about,
)
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.reader import Capture, open_capture, open_quickly
from bilprov.captures.schemas import MS, Chunk, Line, Look
from bilprov.captures.topics import HOST_RAW
from bilprov.spec.by_effect import effect_words
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.filters.filter import Filter
    from bilprov.analyzer.monitor.passive_judge import PassiveJudge
    from bilprov.analyzer.output.row_columns import RowStyle


@dataclass(frozen=True)
class ReplayOptions:
    """The options of `replay`."""

    path: str = argument(metavar="FILE.mcap")
    rate: float = option(
        type=Finite(0),
        default=1.0,
        help="How fast it is played: 1 as recorded, 2 twice as fast, 0 without pauses.",
    )
    span: WindowOptions = group(WindowOptions)
    shown: ShownOptions = group(ShownOptions)
    duration: float | None = option(
        type=Finite(0, min_open=True),
        help="End after S seconds of the recording, counted from --start.",
    )
    port: str | None = option(
        "--to",
        metavar="PORT",
        type=PortName(),
        help="Also send the host's bytes to a device there and compare its answers.",
    )
    plain: bool = plain_option()
    judged: bool = judge_option()
    half_duplex: bool = half_duplex_option()
    yes: bool = flag("With --to: the device may move, do not ask.")
    only_reading: bool = only_reading_option()
    max_drive: float = max_drive_option()
    line: SendingLineOptions = group(SendingLineOptions)
    truncation_timeout: float | None = timeout_option()

    @property
    def in_lines(self) -> str:
        """The option that does not go with the screen, "" for none."""
        return "--to" if self.port is not None else "--judge" if self.judged else ""


@command(ReplayOptions)
def replay(options: ReplayOptions) -> int:
    """Examples:
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
    port, rate = options.port, options.rate
    if options.judged and port is not None:
        raise click.UsageError("--judge judges the recorded device; for one at --to, use sniff")
    if options.shown.count is not None and port is not None:
        raise click.UsageError("--count counts the frames shown; with --to, --duration ends it")
    if options.judged:
        promise_verdict()
    window = options.span.window(options.duration)
    style = options.shown.style(options.plain, options.in_lines)
    timeout = options.truncation_timeout
    timeout = None if timeout is None else round(timeout * MS)
    opened, protocol = _opened(options, timeout, window, style)
    rows = options.shown.rows.style(protocol, style)
    test = compiled(options.shown.expression, protocol)
    capture = opened.capture
    test = test and test.started(capture.start)
    require_begun(capture, window.first)
    if style == "live":
        _look_through(options, opened, protocol, rows, test, window)
        return 0
    note_each((*said_about(capture, protocol), opened.note))
    if port is not None:
        if not capture.contents.counts.get(HOST_RAW):
            raise click.UsageError(f"{options.path} holds no bytes of the host to send")
        # Before Ctrl-C is taken over, so that it can end the question.
        if options.only_reading:
            require_reading(protocol, _frames(protocol, capture, timeout, window))
        if not options.yes:  # what it does is in the whole capture
            words = effect_words(protocol, _frames(protocol, capture, timeout, window))
            does = "move" if protocol.wheels else "do"
            what = f"the device at {port} will {does} as recorded in {options.path}"
            confirm_effect(protocol, what, words, yes=False)
    with ExitStack() as stack:
        stopper = stack.enter_context(Stopper())
        target, sent = None, 0
        if port is not None:
            from bilprov.analyzer.cli.resend import send_again
            from bilprov.analyzer.replay.comparison import ReplayRun
            from bilprov.analyzer.replay.target import Target, scaled_timeout
            from bilprov.analyzer.transport.ports import open_port

            run = ReplayRun()
            pause = scaled_timeout(capture_timeout(capture, protocol, timeout), rate)
            opened_port = open_port(port, options.line.settings(protocol))
            target = stack.enter_context(
                Target(protocol, opened_port, pause, stopper, run.record, options.max_drive)
            )
        judge = None
        if options.judged:
            from bilprov.analyzer.monitor.passive_judge import PassiveJudge

            attached = capture.metadata.get("attached") != "no"
            judge = PassiveJudge(protocol, paired=heard(capture) >= BOTH, attached=attached)
        output = opened_output(style, protocol, rows, capture.start)
        shown = Shown(output, test, options.shown.count, window)
        pipeline = Pipeline(opened.decoder, Statistics(), shown, judge=judge)
        if target is not None:
            sent = send_again(
                protocol, capture, pipeline, output, target, run, rate, window, stopper
            )
        elif rate or judge:
            events = capture.sights() if judge else opened.events()
            _play(events, pipeline, rate, window, stopper, judge)
        else:
            _show(opened, shown, window, stopper)
    if target is not None and not target.answered_stops:
        from bilprov.analyzer.replay.comparison import UNANSWERED_STOPS

        note(UNANSWERED_STOPS)
        return sent or 1
    if judge is None:
        return sent
    from bilprov.analyzer.output.findings import tell_findings

    return tell_findings(judge.finish(), style)


def _frames(
    protocol: Protocol, capture: Capture, timeout: int | None, window: Window
) -> Iterator[bytes]:
    """The frames that the host sent in the window, those that are cut short among them."""
    decoder = capture_decoder(capture, protocol, timeout)
    inside = ([event] for event in capture.events() if window.has(event.t))
    parts = chain.from_iterable(map(decoder.feed, inside))
    for batch in chain(parts, decoder.finish()):
        for record in batch.records():
            if isinstance(record, HostRecord) and record.judgement:
                yield record.data


def _opened(
    options: ReplayOptions, timeout: int | None, window: Window, style: Format
) -> tuple[Opened, Protocol]:
    """Open the capture, from where the window begins; all of it for what is compared or judged.

    For the screen its index is enough, so that the first rows are there at once.
    """
    seeks = window.first is not None and not options.in_lines
    opened = open_quickly if seeks or style == "live" else open_capture
    capture = opened(options.path)
    protocol = protocol_of(capture)
    if options.half_duplex:
        capture = split(capture, protocol)
    if seeks:
        return opened_at(capture, protocol, window.first or 0, timeout), protocol
    return Opened(capture, capture_decoder(capture, protocol, timeout)), protocol


def _look_through(
    options: ReplayOptions,
    opened: Opened,
    protocol: Protocol,
    rows: RowStyle,
    test: Filter | None,
    window: Window,
) -> None:
    """Show the capture on the screen until it is left."""
    from bilprov.analyzer.screen.browser import Told
    from bilprov.analyzer.screen.feeds import capture_feed
    from bilprov.analyzer.screen.terminal import shown

    capture = opened.capture
    feed = capture_feed(opened, protocol, test, options.shown.count, window)
    # The screen has one line for it, so the file's name stands without its folder.
    named = replace(capture, path=Path(capture.path.name))
    sentences = (*said_about(named, protocol), opened.note)
    feed.notice = "" if feed.live else "; ".join(filter(None, sentences))
    told = Told(
        capture.path.name,
        capture.start,
        capture_line(capture, protocol).byte_time,
        rows,
        options.shown.expression or "",
        test,
        options.rate,
    )
    with Stopper() as stopper:
        try:
            shown(feed, told, stopper)
        finally:
            feed.stop()
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
    playing = paced(events, rate, sleep=sleep, start=window.first, end=window.after)
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
