"""Makes the capture that an edit writes: complete under its name, or not there at all."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from bilprov.analyzer.decode.checkpoint import DecoderState, encoded
from bilprov.analyzer.decode.records import shapes_of
from bilprov.analyzer.decode.session import SessionSettings
from bilprov.analyzer.files import replaced_whole
from bilprov.analyzer.replay.capture_session import capture_settings
from bilprov.analyzer.replay.recorder import CHECKPOINT_STATE, RecordWriter, grammar_metadata
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import MS, Checkpoint, Line
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol


@contextmanager
def new_capture(
    out: Path, start_wall: int, metadata: Mapping[str, str], protocol: Protocol, *, force: bool
) -> Iterator[RecordWriter]:
    """Give the writer of a new capture, which is finished and gets its name when the block ends.

    If the block raises, nothing is left of it. Raises CaptureError where it cannot be written.
    """
    writer: RecordWriter | None = None
    try:
        with replaced_whole(out, force=force) as part:
            writer = RecordWriter(part, start_wall, metadata, shapes_of(protocol))
            try:
                yield writer
            finally:
                if not writer.failed:
                    writer.close()
    except FileExistsError as error:
        raise CaptureError(
            f"{printable(out)} was created by another program meanwhile and is kept: name "
            "another file"
        ) from error
    except ValueError as error:
        raise CaptureError(f"{printable(out)} cannot be written: {error}") from error
    except CaptureError as error:
        cause = error.__cause__
        if not isinstance(cause, OSError) or not (writer is None or writer.failed):
            raise  # the capture that is read
        why = cause.strerror
        raise CaptureError(
            f"{printable(out)} cannot be written ({printable(why)}): make room or name another file"
        ) from error


def edited_metadata(capture: Capture, protocol: Protocol, edit: str) -> dict[str, str]:
    """The metadata of a capture for an edited copy, with a word about the edit.

    The settings of its decoding and the grammar are said, so that they do not depend on what is
    left of it.
    """
    own = {topics.START_KEY, topics.PART}
    about = {key: text for key, text in capture.contents.metadata.items() if key not in own}
    about |= grammar_metadata(protocol)
    about |= decoding_metadata(capture_settings(capture, protocol))
    done = f"{edit} (bilprov {kit_version()})"
    before = about.get(topics.HISTORY)
    about[topics.HISTORY] = "; ".join(filter(None, [before, done]))
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
        about[topics.CUT_START] = str(first)
        about["attached"] = "yes"  # for decoders that cannot use the checkpoint
    if after is not None:
        about[topics.CUT_END] = str(after)
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
