"""Makes the capture that an edit writes, complete under its name or not there at all.

What an old capture holds is taken in batches, with the times at which a decoder takes it, and
copied; or written with all that can be decoded from its bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.checkpoint import DecoderState, encoded, encoded_or_none
from bilprov.analyzer.decode.records import shapes_of
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.files import replaced_whole
from bilprov.analyzer.replay.capture_decoding import (
    Progress,
    capture_settings,
    capture_timeout,
    heard,
)
from bilprov.analyzer.replay.recorder import (
    CHECKPOINT_STATE,
    Checkpoints,
    RecordWriter,
    decoding_metadata,
    grammar_metadata,
)
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Checkpoint, Chunk, Line, Recorded, Resumption, look_class
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

BATCH_VALUES = 1 << 12
_BATCH_BYTES = 1 << 15


class Timed(NamedTuple):
    """A recorded value, and when it came as a decoder takes it (ns): never before another one."""

    now: int
    value: Recorded


def timed(values: Iterator[Recorded], now: int) -> Iterator[Timed]:
    """Yield recorded values, the first of which come at `now` (ns) or later, with their times."""
    for value in values:
        now = max(now, value.t)
        yield Timed(now, value)


def batched(values: Iterator[Timed], most: int = BATCH_VALUES) -> Iterator[list[Timed]]:
    """Yield values in lists of at most `most`, with about 32 KiB of raw bytes.

    No more is taken than is handed out: who stops in between can go on with the rest of `values`.
    """
    batch: list[Timed] = []
    size = 0
    for one in values:
        batch.append(one)
        size += len(one.value.data) if isinstance(one.value, Chunk) else 0
        if len(batch) >= most or size >= _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def parted(batches: Iterator[list[Timed]]) -> Iterator[list[Timed]]:
    """Yield the batches in such parts that each Resumption is the first of one."""
    for batch in batches:
        begin = 0
        for place, one in enumerate(batch):
            if place > begin and isinstance(one.value, Resumption):
                yield batch[begin:place]
                begin = place
        yield batch[begin:]


def events_in(batch: list[Timed]) -> list[Chunk | Line]:
    """The chunks and line events of a batch."""
    return [one.value for one in batch if isinstance(one.value, Chunk | Line)]


def size_of(batch: list[Timed]) -> int:
    """How many raw bytes a batch holds."""
    return sum(len(one.value.data) for one in batch if isinstance(one.value, Chunk))


def write_values(out: RecordWriter, batch: list[Timed]) -> None:
    """Write a batch as it is, but for checkpoints from which decoding need not go on."""
    for one in batch:
        if isinstance(one.value, Chunk | Line):
            out.event(one.value)
        elif not isinstance(one.value, Checkpoint):
            out.write(one.value, one.value.t)


def copy_batch(
    out: RecordWriter,
    decoder: StreamDecoder,
    checkpoints: Checkpoints,
    batch: list[Timed],
    size: int,
    *,
    decoded: bool = False,
) -> int:
    """Write and decode a batch, and write a checkpoint if one is due.

    With `decoded` what it completes is written too. `size` raw bytes were copied before; returns
    how many are now.
    """
    write_values(out, batch)
    records = decoder.feed(events_in(batch))
    if decoded:
        write_records(out, records)
    size += size_of(batch)
    made = checkpoints.made(batch[-1].now, size, lambda: encoded_or_none(decoder.saved()))
    if made:
        out.write(made, made.t)
    return size


def write_records(out: RecordWriter, batches: Iterable[Batch]) -> None:
    """Write all records of decoded batches."""
    for batch in batches:
        for record in batch.records():
            out.record(record)


def first_state(decoder: StreamDecoder) -> DecoderState:
    """The state of a decoder that was fed nothing since it was opened."""
    state = decoder.saved()
    assert state is not None  # boundaries are looked for only from a byte on
    return state


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


def split_metadata(capture: Capture, protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture of one wire for a copy in which the directions are told apart."""
    about = edited_metadata(capture, protocol, f"both directions of {said_of(capture.path)}")
    if "port_host" in about:
        about["port_wire"] = about.pop("port_host")
    return about | {"heard": " ".join(sorted(BOTH)), "skew_ms": "0"}


def write_split(
    capture: Capture, protocol: Protocol, out: RecordWriter, progress: Progress
) -> None:
    """Write what was recorded by one tap on a wire, each byte with the direction that it has.

    Raises UserError where the capture has the directions already, and CaptureError where it cannot
    be read.
    """
    if heard(capture) >= BOTH:
        raise UserError(
            f"{printable(capture.path)} has the directions apart already: --half-duplex is for a "
            "capture of one tap"
        )
    wire = HalfDuplex(protocol, capture_timeout(capture, protocol))
    for value in capture.recorded(looks=look_class(protocol.state_type)):
        values: list[Recorded] = []
        if isinstance(value, Chunk):
            progress(len(value.data))
            values += wire.feed(value.data, value.t)
        else:
            values += [*wire.rest(), value]
        write_values(out, [Timed(one.t, one) for one in values])
    write_values(out, [Timed(one.t, one) for one in wire.rest()])


def decoded_metadata(capture: Capture, protocol: Protocol) -> dict[str, str]:
    """The metadata of a capture for a copy whose records are those of this grammar."""
    about = dict(capture.contents.metadata)
    about.pop(topics.START_KEY, None)
    return about | grammar_metadata(protocol)
