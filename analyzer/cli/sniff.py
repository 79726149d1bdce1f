"""`bilprov sniff`: listens to a line, shows the decoded traffic, and records it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import click

from bilprov.analyzer.cli.options import (
    Command,
    compiled,
    filter_option,
    judge_option,
    line_options,
    note,
    session_format_option,
    timeout_option,
)
from bilprov.analyzer.decode.session import BOTH, SKEW, Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.findings import tell_findings
from bilprov.analyzer.output.outputs import Format, Shown, chosen_format, opened_output
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.analyzer.taps.sources import TAPS, Source, opened_tap
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Line

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
@click.option("--count", type=click.IntRange(1), help="End after so many frames were shown.")
@click.option("--duration", type=click.FloatRange(0, min_open=True), help="End after S seconds.")
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
    count: int | None,
    duration: float | None,
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
    protocol = load_protocol(grammar)
    settings = line_settings(protocol, baud, parity, stopbits)
    test = compiled(expression, protocol)
    timeout = timeout_in_ns(protocol, truncation_timeout)
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
        output = opened_output(
            chosen_format(style), protocol, statistics, f"{title} {settings}", _kept(recorder)
        )
        stack.callback(output.close)
        pipeline = Pipeline(
            Session(
                protocol,
                timeout=timeout,
                heard=source.heard,
                skew=skew,
                attached=source.attached,
            ),
            statistics,
            Shown(output, test, count),
            recorder,
            judge=judge,
        )
        pipeline.event(Line(0, "open", "", title))
        lost = _listen(source, pipeline, stopper, duration)
        pipeline.event(Line(source.now(), "close"))
        pipeline.finish()
    _tell(statistics, recorder, live=chosen_format(style) == "live")
    code = tell_findings(judge.finish(), chosen_format(style)) if judge else 0
    if lost:
        kept = f"; what was captured is kept in {path}" if path else ""
        raise LinkError(lost + kept)
    return code


def _listen(source: Source, pipeline: Pipeline, stopper: Stopper, duration: float | None) -> str:
    """Process events until the end; return a sentence about a lost port, or an empty string."""
    end = None if duration is None else round(duration * 1e9)
    while not stopper.stopped and not pipeline.shown.full:
        now = source.now()
        pipeline.advance(now)
        if end is not None and now >= end:
            break
        due = [at for at in (pipeline.session.deadline, end) if at is not None]
        wait = min([LONGEST_WAIT, *((at - now) / 1e9 for at in due)])
        lost = ""
        for event in source.poll(max(0.0, wait), [stopper.fileno()]):
            pipeline.event(event)
            if isinstance(event, Line) and event.event == "unplugged":
                lost = event.detail
        if lost:
            return lost
    return ""


def _kept(recorder: Recorder | None) -> Callable[[], str]:
    return lambda: f"{recorder.path.name} {recorder.bytes} B" if recorder else ""


def _tell(statistics: Statistics, recorder: Recorder | None, *, live: bool) -> None:
    """Print the totals in one line, after a live view or if a capture was recorded."""
    if live or recorder:
        where = f" in {recorder.path}" if recorder else ""
        note(
            f"{statistics.instructions} instructions, {statistics.responses} answers, "
            f"{statistics.fault_count} faults{where}"
        )
