"""`bilprov browse`: looks through a capture on the full screen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from bilprov.analyzer.cli.options import (
    compiled,
    filter_option,
    row_options,
    row_style,
    timeout_option,
)
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import MS


@click.command()
@click.argument("path", metavar="FILE.mcap")
@filter_option
@row_options
@timeout_option
@click.pass_obj
def browse(
    grammar: str | None,
    path: str,
    expression: str | None,
    time_style: str | None,
    columns: str | None,
    truncation_timeout: float | None,
) -> int:
    """Look through a capture: frames, their fields and bits, faults, the predicted state.

    Keys are those of Wireshark, less and vim; ? lists them. The first rows are there at once, the
    others while one looks; nothing is written but what is exported with x.
    """
    protocol = load_protocol(grammar)
    rows = row_style(time_style, columns, protocol)
    test = compiled(expression, protocol)
    timeout = None if truncation_timeout is None else round(truncation_timeout * MS)

    from bilprov.analyzer.replay.capture_session import capture_line, said_about
    from bilprov.analyzer.transport.signals import Stopper
    from bilprov.captures.indexed import open_indexed
    from bilprov.captures.reader import open_capture
    from bilprov.captures.text import printable

    capture = open_indexed(path) or open_capture(path)

    from bilprov.analyzer.output.outputs import has_terminal

    if not has_terminal():
        raise click.UsageError(
            "browse needs a terminal to show a screen on and to take keys from; for lines of text "
            f"use bilprov replay --rate 0 {printable(path)}"
        )

    from bilprov.analyzer.screen.browser import Told
    from bilprov.analyzer.screen.feeds import capture_feed
    from bilprov.analyzer.screen.terminal import shown

    feed = capture_feed(capture, protocol, timeout)
    # The screen has one line for it, so the file's name stands without its folder.
    named = replace(capture, path=Path(capture.path.name))
    feed.notice = "; ".join(said_about(named, protocol))
    told = Told(
        printable(capture.path.name),
        capture.start,
        capture_line(capture, protocol).byte_time,
        rows,
        expression or "",
        test.started(capture.start) if test else None,
    )
    with Stopper() as stopper:
        shown(feed, told, stopper)
        feed.join()
    return 0
