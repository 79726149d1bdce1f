"""`bilprov sniff`: listens to a line, shows the decoded traffic, and records it."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import click

from bilprov.analyzer.cli.options import (
    Command,
    Finite,
    compiled,
    filter_option,
    judge_option,
    line_options,
    note,
    row_options,
    row_style,
    session_format_option,
    timeout_option,
)
from bilprov.analyzer.columns.decoder import StreamDecoder, preload
from bilprov.analyzer.decode.session import BOTH, SKEW
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.findings import tell_findings
from bilprov.analyzer.output.outputs import (
    Format,
    NoOutput,
    Output,
    Shown,
    StreamOutput,
    chosen_format,
    opened_output,
)
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.output.text_queue import TextQueue
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.analyzer.taps.sources import TAPS, Source, opened_tap
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Line

COLLECT_IDLE, COLLECT_BUSY = 1.0, 60.0  # s between collections of garbage
PATIENCE = 50_000_000  # ns; the screen is drawn less often than that
LONGEST_WAIT = 0.05  # s; the capture is flushed and the screen drawn in between


def tap_options(command: Command) -> Command:
    """Add the option of each kind of tap that has one, under the option's name."""
    for tap in reversed(TAPS):
        if tap.option:
            command = click.option(f"--{tap.option}", metavar=tap.metavar, help=tap.help)(command)
    return command


@click.command()
@click.argument("host", required=False)
@click.argument("device", required=False)
@tap_options
@click.option("-w", "--write", "path", metavar="FILE.mcap", help="Log into a new capture file.")
@filter_option
@session_format_option
@row_options
@click.option("--count", type=click.IntRange(1), help="End after so many frames were shown.")
@click.option("--duration", type=Finite(0, min_open=True), help="End after S seconds.")
@click.option("--quiet", is_flag=True, help="Show nothing but the totals at the end.")
@judge_option
@line_options
@timeout_option
@click.option("--yes", is_flag=True, help="Taken for the sake of scripts: nothing is asked here.")
@click.pass_obj
def sniff(
    grammar: str | None,
    /,
    host: str | None,
    device: str | None,
    path: str | None,
    expression: str | None,
    style: Format | None,
    time_style: str | None,
    columns: str | None,
    count: int | None,
    duration: float | None,
    quiet: bool,
    judged: bool,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    truncation_timeout: float | None,
    yes: bool,
    **taps: str | None,
) -> int:
    """Listen to a line, decode and log it.

    HOST carries what the host sends, DEVICE what the device answers. Nothing is ever written to
    them. With --bridge PORT the host program opens the pty whose name is printed (on standard
    error) and every byte is passed on.

    With --judge a table at the end (with --format jsonl a last object of kind judgement) tells
    which parts of the document the traffic covered and what contradicts it; exit code 1 if
    anything does.
    """
    style = chosen_format(style)
    protocol = load_protocol(grammar)
    settings = line_settings(protocol, baud, parity, stopbits)
    test = compiled(expression, protocol)
    rows = row_style(time_style, columns, protocol, style)
    timeout = timeout_in_ns(protocol, truncation_timeout)
    preload(protocol)
    with ExitStack() as stack:
        stopper = stack.enter_context(Stopper())
        given = {"": (host, device), **{option: (name,) for option, name in taps.items()}}
        try:
            source = stack.enter_context(opened_tap(given, settings))
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        skew = 0 if source.one_clock else SKEW
        recorder = None
        if path:
            metadata = session_metadata(
                protocol,
                ports=source.names,
                line=str(settings),
                timeout=timeout,
                skew=skew,
                heard=source.heard,
                attached=source.attached,
            )
            recorder = stack.enter_context(Recorder(path, source.start_wall, metadata))
        statistics = Statistics(protocol, settings.byte_time)
        judge = None
        if judged:
            judge = PassiveJudge(protocol, paired=source.heard >= BOTH, attached=source.attached)
        if source.served:
            note(source.served)
        title = " ".join(f"{part} {name}" for part, name in source.names.items())
        output: Output = NoOutput()
        queue = None
        if not quiet:
            queue = stack.enter_context(TextQueue(sys.stdout))
            shown_as = f"{title} {settings}"
            output = opened_output(
                style,
                protocol,
                statistics,
                shown_as,
                rows,
                source.start_wall,
                _kept(recorder),
                queue.write,
            )
        stack.callback(output.close)
        pipeline = Pipeline(
            StreamDecoder(
                protocol,
                timeout=timeout,
                heard=source.heard,
                skew=skew,
                attached=source.attached,
            ),
            statistics,
            Shown(output, test, count),
            recorder,
            judge,
            0 if isinstance(output, StreamOutput) else PATIENCE,
        )
        pipeline.events([Line(0, "open", "", title)])
        lost = _listen(source, pipeline, stopper, duration)
        pipeline.events([Line(source.now(), "close")])
        pipeline.finish()
        if recorder:  # before the text, which waits for somebody to read it
            recorder.close()
    _tell(statistics, recorder, queue, always=quiet or style == "live")
    code = tell_findings(judge.finish(), style) if judge else 0
    if lost:
        kept = f"; what was captured is kept in {path}" if path else ""
        raise LinkError(lost + kept)
    return code


def _listen(source: Source, pipeline: Pipeline, stopper: Stopper, duration: float | None) -> str:
    """Process events until the end; return a sentence about lost bytes or a lost port, or ""."""
    end = None if duration is None else round(duration * 1e9)
    overrun, waited = "", 0
    with collecting_when_idle() as collect:
        while not stopper.stopped and not pipeline.shown.full:
            now, due = source.now(), pipeline.deadline
            if due is None or due > now:
                pipeline.tick(now)
            else:
                pipeline.advance(now)
                due = pipeline.deadline
            if end is not None and now >= end:
                break
            wait = LONGEST_WAIT
            for at in (due, end):
                if at is not None:
                    wait = min(wait, max(0.0, (at - now) / 1e9))
            events = source.poll(wait, [stopper.fileno()])
            collect(not events)
            if not events:
                continue
            if pipeline.recorder and pipeline.recorder.waited_ns > waited:
                more, waited = pipeline.recorder.waited_ns - waited, pipeline.recorder.waited_ns
                detail = f"nothing was read for {more / 1e9:.3f} s: the capture file was too slow"
                events.insert(0, Line(events[0].t, "waited", "", detail))
            pipeline.events(events)
            for event in events:
                if isinstance(event, Line) and event.event == "unplugged":
                    return event.detail
                if isinstance(event, Line) and event.event == "overrun":
                    overrun = f"bytes of the {event.tap} were lost on the way: {event.detail}"
    return overrun


@contextmanager
def collecting_when_idle() -> Iterator[Callable[[bool], None]]:
    """Turn the garbage collector off in the block, where it would stop the reader at any moment.

    The block gets a function to call again and again with whether nothing is to be done now: then
    garbage is collected, at most once a second, and on a line that is never idle once a minute.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    collected = time.monotonic()

    def collect(idle: bool) -> None:
        nonlocal collected
        if time.monotonic() - collected > (COLLECT_IDLE if idle else COLLECT_BUSY):
            gc.collect()
            collected = time.monotonic()

    try:
        yield collect
    finally:
        gc.enable()
        gc.unfreeze()


def _kept(recorder: Recorder | None) -> Callable[[], str]:
    return lambda: f"{recorder.path.name} {recorder.bytes} B" if recorder else ""


def _tell(
    statistics: Statistics, recorder: Recorder | None, queue: TextQueue | None, *, always: bool
) -> None:
    """Print the totals in one line, if a capture was recorded or else `always`."""
    if not always and not recorder:
        return
    where = f" in {recorder.path}" if recorder else ""
    waited = (recorder.waited_ns if recorder else 0) + (queue.waited_ns if queue else 0)
    late = f"; the reader waited {waited / 1e9:.3f} s for slow output" if waited else ""
    note(
        f"{statistics.instructions} instructions, {statistics.responses} answers, "
        f"{statistics.fault_count} faults{where}{late}"
    )
