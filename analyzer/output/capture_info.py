"""The one-page summary of a capture that `bilprov info` shows, made without decoding it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, table
from bilprov.captures.reader import Capture
from bilprov.captures.text import printable
from bilprov.captures.topics import DEVICE_RAW, HOST_RAW
from bilprov.spec.protocol import Protocol

SECOND = 1_000_000_000  # ns


@dataclass(frozen=True, slots=True)
class Summary:
    """The values that `bilprov info` shows of a capture.

    `start` is ISO 8601 in UTC, `duration` is in s, `counts` are messages by topic, `bytes` raw
    bytes by direction. `same_grammar` tells whether the capture was recorded with the grammar in
    use, None if the capture does not say.
    """

    path: str
    size: int
    library: str
    start: str
    duration: float
    metadata: dict[str, str]
    same_grammar: bool | None
    counts: dict[str, int]
    bytes: dict[str, int]
    unfinished: bool
    damage: tuple[str, ...]


def summarized(capture: Capture, protocol: Protocol) -> Summary:
    """Summarize an opened capture; text from the file is not escaped here."""
    contents = capture.contents
    hashes = [value for key, value in capture.metadata.items() if key.endswith("sha256")]
    return Summary(
        path=str(capture.path),
        size=contents.size,
        library=capture.library,
        start=_moment(capture.start),
        duration=max(0, contents.last - capture.start) / SECOND,
        metadata=dict(capture.metadata),
        same_grammar=protocol.sha256 in hashes if hashes else None,
        counts=dict(contents.counts),
        bytes={
            "host": contents.sizes.get(HOST_RAW, 0),
            "device": contents.sizes.get(DEVICE_RAW, 0),
        },
        unfinished=capture.unfinished,
        damage=capture.damage,
    )


def _moment(wall: int) -> str:
    """Format a wall-clock time in ns as ISO 8601, or as a number if it is outside the calendar."""
    try:
        return datetime.fromtimestamp(wall // SECOND, UTC).isoformat()
    except (OverflowError, OSError, ValueError):
        return str(wall)


def drawn(summary: Summary) -> Iterator[RenderableType]:
    """Yield the parts to print; text from the file is escaped."""
    yield heading(printable(summary.path))
    yield facts(_about(summary))
    yield Text()
    yield table(
        ("topic", "messages"),
        [(printable(topic), f"{count:,}") for topic, count in sorted(summary.counts.items())],
        right="messages",
    )
    if summary.unfinished:
        yield Text()
        yield Text(
            "  The recording was not finished (killed or cut short); all that is whole is read.",
            style="yellow",
        )
    for sentence in summary.damage:
        yield Text(f"  damaged: {printable(sentence)}", style="yellow")


def _about(summary: Summary) -> Iterator[tuple[str, str]]:
    yield "size", f"{summary.size:,} bytes"
    yield "written by", printable(summary.library) or "unknown"
    yield "start", summary.start
    yield "duration", f"{summary.duration:.3f} s"
    for key, value in sorted(summary.metadata.items()):
        if key != "start":  # shown above, as a date
            yield printable(key.replace("_", " ")), printable(value)
    if summary.same_grammar is not None:
        yield "recorded with", f"{'the' if summary.same_grammar else 'not the'} grammar in use"
    yield "host sent", f"{summary.bytes['host']:,} bytes"
    yield "device sent", f"{summary.bytes['device']:,} bytes"
