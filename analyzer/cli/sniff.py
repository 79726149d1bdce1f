"""`bilprov sniff`: listens to a line, shows the decoded traffic, and records it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import rich_click as click

from bilprov.analyzer.cli.options import (
    compiled,
    filter_option,
    judge_option,
    line_options,
    note,
    opened_output,
    timeout_option,
)
from bilprov.analyzer.decode.session import BOTH, SKEW, Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.monitor.passive_judge import PassiveJudge
from bilprov.analyzer.output.findings import tell_findings
from bilprov.analyzer.output.outputs import Format, Shown, chosen_format
from bilprov.analyzer.output.statistics import Statistics
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.recorder import Recorder, session_metadata
from bilprov.analyzer.taps.bridge import Bridge
from bilprov.analyzer.taps.passive import Taps, require_two_lines
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings, timeout_in_ns
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Direction, Line

LONGEST_WAIT = 0.05  # s; the capture is flushed and the screen drawn in between


@click.command()
@click.argument("host", required=False)
@click.argument("device", required=False)
@click.option("--bridge", metavar="PORT", help="Instead of taps: sit between. Prints a pty's name.")
@click.option("-w", "--write", "path", metavar="FILE.mcap", help="Log into a new capture file.")
@filter_option
@click.option(
    "--format",
    "style",
    type=click.Choice(["live", "lines", "jsonl"]),
    help="A picture (on a terminal), text lines (in a pipe), or JSON lines.",
)
@click.option("--count", type=click.IntRange(1), help="End after so many frames were shown.")
@click.option("--duration", type=click.FloatRange(0, min_open=True), help="End after S seconds.")
@judge_option
@line_options
@timeout_option
@click.option("--yes", is_flag=True, help="Taken for the sake of scripts: nothing is asked here.")
@click.pass_obj
def sniff(
    grammar: str | None,
    host: str | None,
    device: str | None,
    bridge: str | None,
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
        source, ports = _source(host, device, bridge, settings)
        stack.enter_context(source)
        heard: frozenset[Direction] = BOTH if bridge or device else frozenset({"host"})
        skew = 0 if bridge else SKEW
        attached = not bridge  # no traffic has passed yet through a pty that was just made
        recorder = None
        if path:
            metadata = session_metadata(
                protocol,
                ports=ports,
                line=str(settings),
                timeout=timeout,
                skew=skew,
                heard=heard,
                attached=attached,
            )
            recorder = stack.enter_context(Recorder(path, source.start_wall, metadata))
        statistics = Statistics(protocol, settings.byte_time)
        judge = None
        if judged:
            judge = PassiveJudge(protocol, paired=heard >= BOTH, attached=attached)
        if bridge:
            note(ports["pty"])
        title = " ".join(f"{part} {name}" for part, name in ports.items())
        output = opened_output(
            chosen_format(style), protocol, statistics, f"{title} {settings}", _kept(recorder)
        )
        stack.callback(output.close)
        pipeline = Pipeline(
            Session(protocol, timeout=timeout, heard=heard, skew=skew, attached=attached),
            statistics,
            output,
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


def _source(
    host: str | None, device: str | None, bridge: str | None, settings: LineSettings
) -> tuple[Taps | Bridge, dict[str, str]]:
    """Open the taps or the bridge; also return the names of the ports by role."""
    if bridge is not None:
        if host is not None:
            raise click.UsageError("give either HOST [DEVICE] or --bridge PORT, not both")
        between = Bridge(open_port(bridge, settings))
        return between, {"bridge": bridge, "pty": between.pty_name}
    if host is None:
        raise click.UsageError("what is to be sniffed? Give HOST [DEVICE] or --bridge PORT")
    if device is None:
        return Taps(open_port(host, settings), None), {"host": host}
    try:
        require_two_lines(host, device)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    first = open_port(host, settings)
    try:
        second = open_port(device, settings)
    except LinkError:
        first.close()
        raise
    return Taps(first, second), {"host": host, "device": device}


def _listen(
    source: Taps | Bridge, pipeline: Pipeline, stopper: Stopper, duration: float | None
) -> str:
    """Process events until the end; return a sentence about a lost port, or an empty string."""
    end = None if duration is None else round(duration * 1e9)
    while not stopper.stopped and not pipeline.full:
        now = source.now()
        pipeline.advance(now)
        if end is not None and now >= end:
            break
        due = [at for at in (pipeline.deadline, end) if at is not None]
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
