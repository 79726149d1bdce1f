"""Examines a capture file: what is damaged, where, and what is lost, in bytes and seconds."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from bilprov.analyzer.doctor.finding import Finding, Grade
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture, open_capture
from bilprov.captures.text import quantity

_SHOWN = 20  # places of losses that are told one by one


def of_capture(path: Path) -> Iterator[Finding]:
    """Yield the findings on a capture file; one that blocks where anything of it is lost."""
    try:
        capture = open_capture(path)
        losses = list(islice(capture.losses(), _SHOWN + 1))
    except CaptureError as error:
        yield Finding("file", Grade.BLOCKS, str(error))
        return
    left_out = capture.left_out
    size = capture.contents.size
    seconds = (capture.contents.last - capture.contents.first) / 1e9
    messages = quantity(sum(capture.contents.counts.values()), "message")
    yield Finding("file", Grade.FINE, f"{quantity(size, 'byte')}, {messages} over {seconds:.1f} s")
    for sentence in capture.damage:
        yield Finding("damage", Grade.BLOCKS, sentence)
    for loss in losses[:_SHOWN]:
        when = f"between {loss.before / 1e9:.3f} and {loss.after / 1e9:.3f} s"
        yield Finding("lost", Grade.BLOCKS, f"{when}: {loss.what}")
    if len(losses) > _SHOWN:
        yield Finding("lost", Grade.BLOCKS, "messages are lost in further places")
    yield from _end(capture, left_out)
    if left_out or capture.damage or losses or capture.unfinished:
        new = path.with_name(f"{path.stem}-repaired.mcap")
        words = shlex.join(["bilprov", "capture", "repair", str(path), str(new)])
        share = f"{quantity(left_out, 'byte')} ({left_out / size:.1%}) cannot be read; "
        what = f"{share if left_out else ''}a new file with all the rest"
        yield Finding("mend", Grade.ADVICE, what, words)


def _end(capture: Capture, left_out: int) -> Iterator[Finding]:
    if not capture.unfinished:
        return
    cut = f", and ends inside a record ({quantity(left_out, 'byte')})" if left_out else ""
    grade = Grade.BLOCKS if left_out else Grade.ADVICE
    yield Finding(
        "end",
        grade,
        f"it was never finished: its writer was killed or is still writing{cut}; "
        "up to there it is complete",
    )
