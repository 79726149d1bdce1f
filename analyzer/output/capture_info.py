"""The one-page summary of a capture that `bilprov capture info` shows, made without decoding it.

The JSON of `--json` is one object. Moments are ISO 8601 in UTC, to the microsecond:

- `path`; `size` in bytes; `library`, the program that has written the file.
- `parts`: the files, by name, of a recording that is kept in parts; of one file none.
- `start`, `end`: when the recording began and when its last message came. Of a part, and of what
  `capture cut` or `capture join` has made, when the first message and the last one came.
- `zero`: the moment from which `t` counts in the file's records. A part keeps that of the whole.
- `duration`: from `start` to `end`, in seconds.
- `host`: the name of the machine on which it was recorded, null if the file does not say.
- `kit`: the version of bilprov by which it was recorded, null if by another program.
- `metadata`: the record `bilprov`, as it is in the file, without the grammar's text.
- `same_grammar`: whether it was recorded with the grammar in use, null if the file does not say.
- `counts`: messages by topic. `bytes`: raw bytes, by `host` and `device`.
- `unfinished`: whether the recording was cut short (killed, a full disk).
- `damage`: a sentence for each part of the file that is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, parts_of, table
from bilprov.captures.reader import Capture
from bilprov.captures.text import printable, quantity
from bilprov.captures.topics import CUT_END, CUT_START, DEVICE_RAW, HISTORY, HOST_RAW, MACHINE
from bilprov.spec.protocol import Protocol

SECOND = 1_000_000_000  # ns


def summarized(capture: Capture, protocol: Protocol) -> dict[str, Any]:
    """Summarize an opened capture; the module's docstring explains the keys."""
    contents, sizes = capture.contents, capture.contents.sizes
    begun_later = {HISTORY, CUT_START} & capture.metadata.keys() and contents.first
    start = contents.first if begun_later else capture.start
    end = max(start, contents.last)
    hashes = [value for key, value in capture.metadata.items() if key.endswith("sha256")]
    return {
        "path": str(capture.path),
        "size": contents.size,
        "parts": tuple(part.path.name for part in capture.volumes) if capture.in_parts else (),
        "library": contents.library,
        "start": _moment(start),
        "end": _moment(end),
        "zero": _moment(capture.start),
        "duration": (end - start) / SECOND,
        "host": capture.metadata.get(MACHINE) or None,
        "kit": capture.metadata.get("version") or None,
        "metadata": dict(capture.metadata),
        "same_grammar": protocol.sha256 in hashes if hashes else None,
        "counts": dict(contents.counts),
        "bytes": {"host": sizes.get(HOST_RAW, 0), "device": sizes.get(DEVICE_RAW, 0)},
        **parts_of(capture, "unfinished", "damage"),
    }


def _moment(wall: int) -> str:
    """Format a wall-clock time in ns as ISO 8601."""
    seconds, rest = divmod(wall, SECOND)
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.replace(microsecond=rest // 1000).isoformat(timespec="microseconds")


def drawn(summary: dict[str, Any], *, carried: bool) -> Iterator[RenderableType]:
    """Yield the parts to print; `carried` is whether the file has its grammar's text."""
    yield heading(printable(summary["path"]))
    yield facts(_about(summary, carried))
    yield Text()
    rows = [(topic, f"{count:,}") for topic, count in sorted(summary["counts"].items())]
    yield table(("topic", "messages"), rows, right="messages")
    if summary["unfinished"]:
        yield Text()
        cut = "The recording was not finished (killed or cut short); everything intact is read."
        yield Text(f"  {cut}", style="yellow")
    for sentence in summary["damage"]:
        yield Text(f"  damaged: {sentence}", style="yellow")


def _about(summary: dict[str, Any], carried: bool) -> Iterator[tuple[str, str]]:
    yield "size", quantity(summary["size"], "byte")
    if summary["parts"]:
        named = printable(" to ".join(dict.fromkeys((summary["parts"][0], summary["parts"][-1]))))
        yield "kept in", f"{quantity(len(summary['parts']), 'part')}, {named}"
    yield "written by", summary["library"] or "unknown"
    yield "start", summary["start"]
    yield "end", summary["end"]
    if summary["zero"] != summary["start"]:
        yield "times count from", summary["zero"]
    yield "duration", f"{summary['duration']:.3f} s"
    yield "recorded on", summary["host"] or ""
    yield "recorded by", f"bilprov {summary['kit']}" if summary["kit"] else ""
    for key, value in sorted(summary["metadata"].items()):
        if key not in ("start", "version", MACHINE, CUT_START, CUT_END):  # shown above
            yield key.replace("_", " "), printable(value)
    if summary["same_grammar"]:
        yield "recorded with", "the grammar in use"
    elif summary["same_grammar"] is False:
        which = "the grammar that is in the file" if carried else "not the grammar in use"
        yield "recorded with", which
    yield "host sent", quantity(summary["bytes"]["host"], "byte")
    yield "device sent", quantity(summary["bytes"]["device"], "byte")
