"""`bilprov sniff`: listens to a line, shows the decoded traffic, and records it."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TypeAlias

import click
import msgspec

from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import argument, command, flag, group, option, protocol_in_use
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.cli.streams import say
from bilprov.analyzer.decode.records import shapes_of
from bilprov.analyzer.decode.session import BOTH, SKEW, SessionSettings
from bilprov.analyzer.decode.stream import StreamDecoder, preload
from bilprov.analyzer.grammar_file import not_carried
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.findings import tell_findings
from bilprov.analyzer.output.outputs import Output, Shown, TextQueue, opened_output
from bilprov.analyzer.pipeline import BATCH, Pipeline
from bilprov.analyzer.replay.recorder import (
    Recorder,
    Rotation,
    Spool,
    new_name,
    rotation_at,
    session_metadata,
)
from bilprov.analyzer.taps.sources import Ports, SimulatedDrive, Source, opened_tap
from bilprov.analyzer.transport.errors import SIM, LinkError
from bilprov.analyzer.transport.line_settings import LineSettings, timeout_in_ns
from bilprov.analyzer.transport.replug import opened_when_there
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import said_of_parts
from bilprov.captures.schemas import Line
from bilprov.captures.text import printable, quantity
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

Tell: TypeAlias = Callable[[str], object]
COLLECT_IDLE, COLLECT_BUSY = 1.0, 60.0  # s between collections of garbage
LONGEST_WAIT = 0.05  # s; the capture is flushed and the screen drawn in between


def _rotation_at(ctx: click.Context, param: click.Parameter, text: str | None) -> Rotation | None:
    with shared.refused(click.BadParameter):
        return None if text is None else rotation_at(text)


class SniffOptions(msgspec.Struct, frozen=True):
    """The options of `sniff`."""

    host: str | None = argument(required=False, type=PortName())
    device: str | None = argument(required=False, type=PortName())
    bridge: str | None = shared.port_option(
        help="Sit between host and device, at a pty whose name is printed."
    )
    half_duplex: str | None = shared.port_option(
        help="Listen to one wire that has both directions, as RS-485 and servo buses."
    )
    path: str | None = option(
        "-w", "--write", metavar="FILE.mcap", help="Log into a new capture file."
    )
    rotate: Rotation | None = option(
        metavar="SIZE|TIME",
        callback=_rotation_at,
        help="Begin a new part of the log when one has this size or age, like 100MB or 1h.",
    )
    keep: int | None = option(
        metavar="N", type=click.IntRange(1), help="Keep the newest N parts of this log only."
    )
    shown: shared.ShownOptions = group(shared.ShownOptions)
    duration: float | None = option(
        type=shared.Finite(0, min_open=True), help="End after S seconds."
    )
    wait: bool = flag("Wait for a port that is not there yet, and for one that is unplugged.")
    quiet: bool = flag("Show nothing but the totals at the end.")
    line: shared.LineOptions = group(shared.LineOptions)
    truncation_timeout: float | None = shared.timeout_option()
    yes: bool = flag("Accepted for scripts; sniff asks nothing.")


@command(SniffOptions, only_with={"rotate": ("keep",), "path": ("rotate",)})
def sniff(options: SniffOptions) -> int:
    """Examples:
      bilprov sniff sim
      bilprov sniff /dev/ttyUSB0 /dev/ttyUSB1 -w drive.mcap
      bilprov sniff --bridge /dev/ttyUSB0 --plain

    HOST carries what the host sends, DEVICE what the device answers. Nothing is ever written to
    them. With --bridge PORT the host program opens the pty whose name is printed (on standard
    error) and every byte is passed on. sim is a simulated drive, to try the screen without a
    device. With --half-duplex PORT one tap hears both sides, as on RS-485; requests and answers are
    separated by the grammar.

    On a terminal the traffic is shown on a screen, as by `bilprov replay`; ? lists its keys.
    Without -w the last GiB of it is kept meanwhile, and can be saved when the screen is left.

    With --rotate the log -w drive.mcap is kept in parts, drive.00001.mcap, drive.00002.mcap and so
    on. Each is a capture by itself, and all commands read the parts as one under the name
    drive.mcap.

    A full disk or a deleted capture ends only the recording, which is reported at once and again at
    the end, with exit code 2.

    If a tap is unplugged, sniffing continues on the other one and the exit code is 2; without
    another one it ends. A tap that is plugged in again is listened to again. With --wait a missing
    port does not end it, and a port that came back is not a fault.

    With --judge a table at the end (with --format jsonl a last object of kind judgement) shows
    which parts of the document the traffic covered and what contradicts it; exit code 1 if anything
    does, 3 if no instruction could be judged.
    """
    path, quiet, wait = options.path, options.quiet, options.wait
    style = options.shown.style()
    protocol = protocol_in_use()
    settings = options.line.settings(protocol)
    test = shared.compiled(options.shown.expression, protocol)
    rows = options.shown.rows.style(protocol, style)
    timeout = timeout_in_ns(protocol, options.truncation_timeout)
    preload(protocol)
    kept, broken = "", None
    with ExitStack() as stack:
        stopper = stack.enter_context(Stopper())
        opened = _opened(options, protocol, settings, timeout, stopper)
        if opened is None:
            return 0
        source = stack.enter_context(opened)
        shared.note_hindrances(*source.names.values())
        decoding: SessionSettings = {
            "timeout": shared.above_latency(timeout, *source.names.values()),
            "heard": source.heard,
            "skew": 0 if source.one_clock else SKEW,
            "attached": source.attached,
        }
        test = test and test.started(source.start_wall)
        metadata = session_metadata(protocol, ports=source.names, line=str(settings), **decoding)
        recorder: Recorder | None = None
        if path:
            shared.note(not_carried(protocol))
            rotation = options.rotate and options.rotate._replace(keep=options.keep)
            recorder = Recorder(path, source.start_wall, metadata, rotation, shapes_of(protocol))
        elif style == "live" and not quiet:
            try:
                recorder = Spool(source.start_wall, metadata, shapes=shapes_of(protocol))
            except CaptureError as error:
                shared.note(str(error))
        if recorder:
            stack.enter_context(recorder)
        judge = None
        if options.shown.judged:
            judge = PassiveJudge(protocol, paired=source.heard >= BOTH, attached=source.attached)
        if source.served:
            shared.note(source.served)
        stack.callback(gc.unfreeze)
        stack.callback(gc.enable)
        title = printable(" ".join(f"{part} {name}" for part, name in source.names.items()))
        chosen = Shown(Output(), test, options.shown.count)
        pipeline = Pipeline(StreamDecoder(protocol, **decoding), chosen, recorder, judge, BATCH)

        def listened(tell: Tell) -> str:
            """Listen to the end, and finish the capture; `tell` is told at once what is lost."""
            pipeline.events([Line(0, "open", "", title)])
            lost = _listen(options, source, pipeline, stopper, tell)
            pipeline.events(source.rest())
            pipeline.events([Line(source.seen, "close")])  # of later it is not known what came
            pipeline.finish()
            if recorder:  # before the text, which waits for somebody to read it
                recorder.finish()
            return lost

        if quiet:
            lost = listened(say)
        elif style == "live":
            from bilprov.analyzer.screen.feeds import AllShown, Feed, ScreenOutput, Told
            from bilprov.analyzer.screen.recording import Recording
            from bilprov.analyzer.screen.terminal import shown

            def watched(feed: Feed) -> None:
                feed.said = listened(partial(setattr, feed, "notice"))
                feed.stays = source.ended and not wait

            feed = Feed(Recording(protocol), watched, stopper.stop, live=True)
            feed.keeps = isinstance(recorder, Spool)
            pipeline.shown = AllShown(ScreenOutput(feed, recorder), test, options.shown.count)
            expression = options.shown.expression or ""
            told = Told(title, source.start_wall, settings, rows, expression, test)
            try:
                name = shown(feed, told, stopper)
            except Exception as error:  # who talks over a bridge goes on talking
                say("the screen has failed; listening goes on without it, Ctrl-C ends it")
                broken, name = error, new_name()
            feed.join()
            lost = feed.said
            if name and isinstance(recorder, Spool):
                kept = said_of_parts(recorder.keep(Path(name)))
        else:
            queue = stack.enter_context(TextQueue(sys.stdout))
            chosen.output = opened_output(style, protocol, rows, source.start_wall, queue.write)
            pipeline.patience = 0
            lost = listened(say)
    failure = recorder.failure if path and recorder else ""
    if path and recorder and not failure:
        kept = said_of_parts(recorder.paths)
    if path or quiet or style == "live":
        counts = zip(pipeline.counts, ("instruction", "answer", "fault"), strict=True)
        words = ", ".join(quantity(count, noun) for count, noun in counts)
        shared.note(words + (f" in {kept}" if kept else ""))
    code = tell_findings(judge.finish(), style) if judge else 0
    if lost and kept:
        raise LinkError(f"{lost}; what was captured is kept in {kept}")
    if lost or failure:
        raise UserError("; ".join(filter(None, (lost, failure))))
    if broken:
        raise broken
    return code


def _opened(
    options: SniffOptions,
    protocol: Protocol,
    settings: LineSettings,
    timeout: int,
    stopper: Stopper,
) -> Source | None:
    """Open what was asked for; with `--wait`, once it can be. None if stopped before."""
    given = Ports(options.host, options.device, options.bridge, options.half_duplex)
    if given.host == SIM and not Path(SIM).exists():
        if given != Ports(SIM):
            raise click.UsageError(f"{SIM} is a drive that is simulated as a whole: name it alone")
        shared.only_for_ports(["wait"], SIM)
        return SimulatedDrive(protocol, settings)
    open_it = partial(opened_tap, given, settings, protocol, timeout)
    with shared.refused(click.UsageError):
        return (
            opened_when_there(open_it, lambda: stopper.stopped, say) if options.wait else open_it()
        )


def _listen(
    options: SniffOptions, source: Source, pipeline: Pipeline, stopper: Stopper, tell: Tell
) -> str:
    """Process events until the end, and return in a sentence what was lost, "" for nothing.

    `tell` is told at once of what ends only a part of the work: a port is lost while there is
    another one, or it is to `wait` for it; the capture cannot be written. With `wait` a port that
    is there again is not lost.
    """
    wait, duration = options.wait, options.duration
    end = None if duration is None else round(duration * 1e9)
    lost: dict[str, str] = {}
    recorder, told = pipeline.recorder, False
    gc.collect()
    gc.freeze()
    gc.disable()  # it would stop the reader at any moment; garbage is collected below
    collected = time.monotonic()
    while not (stopper.stopped or pipeline.shown.full or (source.ended and not wait)):
        now, due = source.now(), pipeline.deadline
        if due is None or due > source.seen:
            pipeline.tick(now)
        else:
            pipeline.advance(source.seen)
            due = pipeline.deadline
        if recorder and recorder.failure and not told:
            told = True
            unsaved = isinstance(recorder, Spool)
            why = "the session cannot be saved" if unsaved else recorder.failure
            tell(f"{why}; listening goes on, without recording")
        if end is not None and now >= end:
            break
        waits = [max(0.0, (at - now) / 1e9) for at in (due, end) if at is not None]
        events = source.poll(min([LONGEST_WAIT, *waits]), [stopper.fileno()])
        if time.monotonic() - collected > (COLLECT_BUSY if events else COLLECT_IDLE):
            gc.collect()
            collected = time.monotonic()
        pipeline.busy = source.busy
        pipeline.events(events)
        for event in events:
            if not isinstance(event, Line):
                continue
            if event.event == "unplugged":
                lost[event.tap] = event.detail
                doing = "waiting for" if source.ended else "listening goes on without"
                if wait or not source.ended:
                    tell(f"{doing} the {event.tap}: {event.detail}")
            elif event.event == "reconnected":
                tell(f"{event.detail}, and listened to")
                if wait:
                    lost.pop(event.tap, None)
            elif event.event == "overrun":
                lost["overrun"] = f"bytes of the {event.tap} were lost on the way: {event.detail}"
    return "; ".join(lost.values())
