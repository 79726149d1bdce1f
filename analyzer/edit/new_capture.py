"""Makes the capture that an edit writes: complete under its name, or not there at all."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from bilprov.analyzer.decode.checkpoint import DecoderState, encoded
from bilprov.analyzer.decode.session import SessionSettings
from bilprov.analyzer.files import replaced_whole, why_not_writable
from bilprov.analyzer.replay.capture_session import capture_settings
from bilprov.analyzer.replay.recorder import CHECKPOINT_STATE, RecordWriter
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import MS, Checkpoint, Line
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol

HISTORY: Final = "history"
"""The metadata's key for what was done to a recording, a line for each edit."""

CUT_START: Final = "cut_start_ns"
CUT_END: Final = "cut_end_ns"
"""The metadata's keys for the window that was cut out, in ns since the recording's start."""

Progress = Callable[[int], bool]
"""Is told how many raw bytes were read since it was last called; false ends the work."""


class Stopped(Exception):
    """The user has asked for an end; nothing is written."""


def require_new(out: Path, sources: list[Path], *, force: bool) -> None:
    """Raise CaptureError unless `out` may be written: a new file, or with `force` an old one."""
    name = printable(out)
    for source in sources:
        if _same(out, source):
            raise CaptureError(
                f"{name} is {printable(source)} itself, which would be lost: name another file"
            )
    if out.exists() and not force:
        raise CaptureError(f"{name} exists: name another file, or say --force to replace it")
    if out.exists() and not out.is_file():
        raise CaptureError(f"{name} is no regular file: name a file to write to")
    why_not = why_not_writable(out)
    if why_not:
        raise CaptureError(f"{name} cannot be written: {why_not}")


@contextmanager
def new_capture(
    out: Path, start_wall: int, metadata: Mapping[str, str], *, force: bool
) -> Iterator[RecordWriter]:
    """Give the writer of a new capture, which is finished and gets its name when the block ends.

    If the block raises, nothing is left of it. Raises CaptureError where it cannot be written.
    """
    writer: RecordWriter | None = None
    try:
        with replaced_whole(out, force=force) as part:
            writer = RecordWriter(part, start_wall, metadata)
            try:
                yield writer
            finally:
                if not writer.failed:
                    writer.close()
    except FileExistsError as error:
        raise CaptureError(
            f"{printable(out)} was made by somebody else meanwhile and is kept: name another file"
        ) from error
    except ValueError as error:
        raise CaptureError(f"{printable(out)} cannot be written: {error}") from error
    except CaptureError as error:
        if writer is None or not writer.failed:
            raise
        why = error.__cause__.strerror if isinstance(error.__cause__, OSError) else error
        raise CaptureError(
            f"{printable(out)} cannot be written ({printable(why)}): make room or name another file"
        ) from error


def edited_metadata(capture: Capture, protocol: Protocol, edit: str) -> dict[str, str]:
    """The metadata of a capture for an edited copy, with a line about the edit.

    The settings of its decoding are said, so that they do not depend on what is left of it.
    """
    about = {key: text for key, text in capture.metadata.items() if key != topics.START_KEY}
    about |= decoding_metadata(capture_settings(capture, protocol))
    done = f"{edit} (bilprov {kit_version()})"
    about[HISTORY] = "\n".join(filter(None, [about.get(HISTORY), done]))
    return about


def cut_metadata(
    capture: Capture,
    protocol: Protocol,
    first: int | None,
    after: int | None,
    expression: str | None,
) -> dict[str, str]:
    """The metadata of a part: what a filter selects from `first` to `after` (ns) of a capture."""
    window = {"--start": first, "--end": after}
    words = [f"{name} {t / 1e9:g}" for name, t in window.items() if t is not None]
    words += [f"--filter {printable(expression)}"] if expression else []
    about = edited_metadata(capture, protocol, f"cut {said_of(capture.path)} {' '.join(words)}")
    if first is not None:
        about[CUT_START] = str(first)
        about["attached"] = "yes"  # for decoders that cannot use the checkpoint
    if after is not None:
        about[CUT_END] = str(after)
    return about


def decoding_metadata(settings: SessionSettings) -> dict[str, str]:
    """Settings of a Session as the metadata of a capture says them, without loss."""
    return {
        "truncation_timeout_ms": _milliseconds(settings["timeout"] or 0),
        "skew_ms": _milliseconds(settings["skew"]),
        "heard": " ".join(sorted(settings["heard"])),
        "attached": "yes" if settings["attached"] else "no",
    }


def write_resumption(
    out: RecordWriter, protocol: Protocol, state: DecoderState, t: int, gap: Line | None = None
) -> None:
    """Write a checkpoint at `t` (ns) from which decoding is to go on; a `gap` goes before it.

    A state whose text is too long for a message, which no car's traffic leads to, is left out: then
    decoding looks for frame boundaries after the gap.
    """
    text = encoded(state)
    fits = len(text) <= CHECKPOINT_STATE
    if gap or not fits:
        out.event(gap or Line(t, "gap"))
    if fits:
        out.write(Checkpoint.of(t, protocol.sha256, text, resumes=True), t)


def said_of(name: Path) -> str:
    """A file's name as it stands in a history: without its folder, safe to show."""
    return re.sub(r"\s+", " ", printable(name.name))


def _milliseconds(t: int) -> str:
    short = f"{t / MS:g}"
    return short if float(short) * MS == t else repr(t / MS)


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return one.absolute() == other.absolute()
