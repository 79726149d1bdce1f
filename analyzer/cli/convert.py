"""`bilprov convert`: writes a capture anew, with all that can be decoded from it."""

from __future__ import annotations

import sys
from contextlib import ExitStack

import click

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.capture_session import said_about
from bilprov.analyzer.replay.conversion import write_decoded
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.reader import open_capture
from bilprov.captures.text import printable
from bilprov.captures.topics import TOPICS

PROGRESS_EVERY = 500  # messages


@click.command()
@click.argument("path", metavar="IN.mcap")
@click.argument("new", metavar="OUT.mcap")
@click.option("--decoded", is_flag=True, help="Write every decoded frame, answer and state.")
@click.pass_obj
def convert(grammar: str | None, path: str, new: str, decoded: bool) -> int:
    """Write a capture anew.

    With --decoded OUT holds what IN does, and every frame, answer, state and fault decoded from
    its bytes: also those that were not written while traffic was heavy. IN may be of an older kit
    or of another program, unfinished or damaged. OUT must not exist; Ctrl-C leaves none.
    """
    if not decoded:
        raise click.UsageError("say what OUT is to hold: --decoded is all that there is")
    protocol = load_protocol(grammar)
    capture = open_capture(path)
    for sentence in said_about(capture, protocol):
        note(sentence)
    counts = capture.contents.counts
    known = {topic.name for topic in TOPICS}
    if others := [topic for topic in counts if topic not in known]:
        note(f"left out, since they are none of bilprov's topics: {printable(', '.join(others))}")
    with ExitStack() as stack:
        stopper = stack.enter_context(Stopper())
        seen = 0
        shown = None
        if sys.stderr.isatty():
            bar = click.progressbar(
                length=sum(counts.values()), file=sys.stderr, label=printable(capture.path)
            )
            shown = stack.enter_context(bar)

        def go_on() -> bool:
            nonlocal seen
            seen += 1
            if shown and seen % PROGRESS_EVERY == 0:
                shown.update(PROGRESS_EVERY)
            return not stopper.stopped

        done = write_decoded(capture, protocol, new, go_on)
    if not done:
        note(f"stopped: {printable(new)} was not written")
        raise click.Abort
    note(f"{printable(path)} is in {printable(new)}, with all that is decoded from it")
    return 0
