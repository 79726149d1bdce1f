"""Records a session into a capture: the raw bytes, and the records decoded from them.

It may be kept in parts, or in temporary parts of bounded size, which can be kept under a name.
"""

from __future__ import annotations

import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from decimal import Decimal
from pathlib import Path
from typing import Final, NamedTuple, Unpack

from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, Severity
from bilprov.analyzer.decode.session import SessionSettings
from bilprov.analyzer.version import kit_version
from bilprov.captures import topics
from bilprov.captures.background import BackgroundWriter
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import part_path, part_paths, require_new
from bilprov.captures.schemas import MS, Checkpoint, Chunk, Line, Resumption
from bilprov.captures.storage.records import STRING_BYTES
from bilprov.captures.text import printable
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

SIZES: Final[Mapping[str, int]] = {
    "kb": 10**3,
    "mb": 10**6,
    "gb": 10**9,
    "kib": 2**10,
    "mib": 2**20,
    "gib": 2**30,
}  # bytes
TIMES: Final[Mapping[str, int]] = {"s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9}  # ns
LEAST_SIZE: Final = 100_000  # bytes; what a file holds beside the traffic takes some 10,000
LEAST_TIME: Final = 10**9  # ns
MOST: Final = 10**19  # bytes or ns, some 300 years
_VALUE = re.compile(r"(\d{1,15}(?:\.\d{1,9})?) ?([a-z]+)", re.IGNORECASE | re.ASCII)


class Rotation(NamedTuple):
    """When a part of a recording is full, and how many are kept.

    It is at `size` bytes of the file or at an `age` in ns, where they are given. The newest `keep`
    parts are kept, the one that is written included; None stands for all.
    """

    size: int | None = None
    age: int | None = None
    keep: int | None = None


def rotation_at(text: str) -> Rotation:
    """The Rotation at a size or a time with its unit, like "100MB" or "1h", in any case.

    Raises ValueError, in a sentence, for anything else.
    """
    match = _VALUE.fullmatch(text)
    unit = match[2].lower() if match else ""
    amount = Decimal(match[1]) if match else Decimal(0)
    size = int(amount * SIZES.get(unit, 0))
    age = int(amount * TIMES.get(unit, 0))
    if not LEAST_SIZE <= size <= MOST and not LEAST_TIME <= age <= MOST:
        raise ValueError(
            f"{printable(text)} is neither a size of 100 kB or more (kB, MB, GB, KiB, MiB, GiB) "
            "nor a time of 1 s or more (s, min, h): write 100MB or 1h, for example"
        )
    return Rotation(size=size or None, age=age or None)


SECOND: Final = 1_000_000_000  # ns
STOP_ABOVE: Final = 2_000  # host frames within a second
RESUME_BELOW: Final = STOP_ABOVE // 2  # host frames/s
RESUME_AFTER: Final = 5 * SECOND


class Throttle:
    """Counts host frames by the second. `stopped` tells whether the decoded topics are stopped.

    They stop as soon as more than 2,000 frames came within one second, which at a high rate is long
    before the second is over, and resume after 5 s in which every second had less than 1,000.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._began = 0  # of the second that is counted, ns
        self._last = 0  # when frames were last counted
        self._frames = 0
        self._calm_since = 0

    def count(self, frames: int, now: int) -> tuple[str, str] | None:
        """Count frames that came until `now` (ns); 0 lets time pass.

        When the topics stop or resume, returns which, and why in words.
        """
        ended, rate = now - self._began > SECOND, self._frames
        if ended:
            if rate >= RESUME_BELOW:
                self._calm_since = self._last
            # After a pause the second begins with what ends the pause.
            self._began = self._last if now - self._last < SECOND else now
            self._frames = 0
        self._last = now
        self._frames += frames
        if self._frames > STOP_ABOVE:
            if self.stopped:
                return None
            self.stopped = True
            return "decoded topics stopped", (
                f"{self._frames:,} host frames within a second, allowed are {STOP_ABOVE:,}: from "
                "here on the raw bytes alone are recorded (bilprov capture decode adds the rest)"
            )
        if ended and self.stopped and now - self._calm_since >= RESUME_AFTER:
            self.stopped = False
            return "decoded topics resumed", (
                f"{rate:,} host frames within a second, for {RESUME_AFTER // SECOND} s less than "
                f"{RESUME_BELOW:,}: from here on everything is recorded again"
            )
        return None


# A call comes some 50 ms or a read later than what it is due at: so a little less than 1 s, 64 KiB.
CHECKPOINT_AFTER: Final = 900 * MS
CHECKPOINT_BYTES: Final = 60 * 1024
CHECKPOINT_STATE: Final = 30_000  # characters; what is longer would not fit into a message


def session_metadata(
    protocol: Protocol,
    *,
    ports: Mapping[str, str],
    line: str,
    **settings: Unpack[SessionSettings],
) -> dict[str, str]:
    """The capture's metadata record `bilprov`, which a replay needs to decode in the same way.

    `ports` maps each port's role to its name, `line` is the line settings as text, `settings` are
    those of the Session that decodes.
    """
    return {
        "version": kit_version(),
        **grammar_metadata(protocol),
        topics.MACHINE: platform.node(),
        **{f"port_{part}": name for part, name in ports.items()},
        "line": line,
        "clock": "monotonic; log_time = wall clock at start + monotonic",
        **decoding_metadata(settings),
    }


def decoding_metadata(settings: SessionSettings) -> dict[str, str]:
    """Settings of a Session as the metadata of a capture says them, without loss."""
    return {
        "truncation_timeout_ms": f"{(settings['timeout'] or 0) / MS:.15g}",
        "skew_ms": f"{settings['skew'] / MS:.15g}",
        "heard": " ".join(sorted(settings["heard"])),
        "attached": "yes" if settings.get("attached") else "no",
    }


def grammar_metadata(protocol: Protocol) -> dict[str, str]:
    """The grammar as the metadata of a capture say it: names, hash, and its text.

    A text that is too long for a metadata record is left out.
    """
    fits = len(protocol.source.encode()) <= STRING_BYTES
    return {
        "grammar_name": protocol.name,
        "grammar_version": protocol.version,
        topics.GRAMMAR_HASH: protocol.sha256,
        topics.GRAMMAR_TEXT: protocol.source if fits else "",
    }


class RecordWriter(CaptureWriter):
    """Writes events and all records into a capture, in the thread that calls it.

    Raises CaptureError where the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        start_wall: int,
        metadata: Mapping[str, str],
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        super().__init__(
            path, start_wall=start_wall, metadata=metadata, version=kit_version(), shapes=shapes
        )
        self._state: State | None = None

    def event(self, event: Chunk | Line) -> None:
        """Write a raw event, before it is decoded; a Resumption as the two messages it is."""
        if isinstance(event, Chunk):
            self.chunk(event)
        elif isinstance(event, Resumption):
            if not event.silent:
                self.write(event.gap, event.t)
            self.write(event.checkpoint, event.checkpoint.t)
        else:
            self.write(event, event.t)

    def record(self, record: Record) -> None:
        """Write a decoded record: the frame, the state when it changes, and the anomalies."""
        if isinstance(record, HostRecord):
            self.write(record.value, record.value.t)
            if record.state != self._state:
                self.write(record.state, record.value.end)
                self._state = record.state
        elif isinstance(record, DeviceRecord):
            self.write(record.value, record.value.t)
        for fault in record.faults:
            self.log(fault.t, int(fault.severity), fault.reason, fault.kind)

    def forget_state(self) -> None:
        """Have the next state written though it is the last one that was."""
        self._state = None


class Checkpoints:
    """Makes a checkpoint at least every 64 KiB of raw bytes, and every second with traffic.

    `grammar` is the sha256 of the grammar that decodes.
    """

    def __init__(self, grammar: str) -> None:
        self._grammar = grammar
        self._bytes = 0
        self._t = 0

    def made(
        self, t: int, total: int, save: Callable[[], str | None], *, begins: bool = False
    ) -> Checkpoint | None:
        """The checkpoint at `t` (ns), after `total` raw bytes; None if none is due, or can be.

        `save` gives the decoder's state as JSON text, or None if it cannot be told now. One with
        which a part `begins`, from which decoding it goes on, is always due.
        """
        fresh = total - self._bytes
        waited = fresh and t - self._t >= CHECKPOINT_AFTER
        due = begins or waited or fresh >= CHECKPOINT_BYTES
        state = save() if due else None
        if state is None:
            return None
        self._bytes, self._t = total, t
        fits = len(state) <= CHECKPOINT_STATE
        return Checkpoint.of(t, self._grammar, state, begins or None) if fits else None


class Recorder(BackgroundWriter):
    """Records a live session, in a thread behind the reader of the line.

    The decoded topics stop while traffic is over 2,000 frames/s, and `/faults` says when
    (`Throttle`); the raw events are always written. A checkpoint is due every 64 KiB of raw bytes
    and every second with traffic. `bytes` is how many raw bytes were handed over. Times are ns
    since the session's start; the grammar's hash is the one in `metadata`, `state` the class of its
    states.

    With a `rotation` the session is kept in parts (`captures.parts` has their names), of which each
    is a capture by itself.

    Only making the file raises CaptureError.
    """

    def __init__(
        self,
        path: str | Path,
        start_wall: int,
        metadata: Mapping[str, str],
        rotation: Rotation | None = None,
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        self.bytes = 0
        self._name = Path(path)
        self._metadata = dict(metadata)
        self._rotation = rotation
        self._part = 1
        self._part_since: int | None = None  # the time of the first event in the part
        require_new(self._name)
        if rotation:
            path, metadata = part_path(self._name, 1), {**metadata, topics.PART: "1"}
        self._file = RecordWriter(path, start_wall, metadata, shapes)
        super().__init__(self._file)
        self._throttle = Throttle()
        self._checkpoints = Checkpoints(metadata[topics.GRAMMAR_HASH])

    def part_due(self, now: int) -> bool:
        """Whether the part is full at `now` (ns), so that `checkpoint` begins the next one.

        A part without any event is never full.
        """
        if self._rotation is None or self._part_since is None or self.failure:
            return False
        size, age, _ = self._rotation
        full = size is not None and self.size >= size
        return full or (age is not None and now - self._part_since >= age)

    def events(self, events: Iterable[Chunk | Line]) -> None:
        """Write raw events, before they are decoded."""
        if self.failure:
            return
        for event in events:
            if self._part_since is None:
                self._part_since = event.t
            size = len(event.data) if isinstance(event, Chunk) else 0
            self._put(self._file.event, event, size=size)
            self.bytes += size

    def decoded(self, frames: int, now: int, records: Callable[[], Iterable[Record]]) -> None:
        """Write a decoded batch, which has so many host frames; `records` is called if it is due.

        Call it once for each batch, with 0 frames too.
        """
        self._count(frames, now)
        if not (self.failure or self._throttle.stopped):
            for record in records():
                self._put(self._file.record, record)

    def checkpoint(self, t: int, save: Callable[[], str | None]) -> None:
        """Write a checkpoint at `t` if one is due; call it when all events so far are decoded.

        Where the part is full, the next one begins, with a checkpoint. `save` gives the decoder's
        state as JSON text, and is called only if it is due. Where it gives None, the next call
        tries again; a part then begins without.
        """
        if self.failure:
            return
        begins = self.part_due(t)
        if begins:
            self._begin_part(t)
        if made := self._checkpoints.made(t, self.bytes, save, begins=begins):
            self.write(made, t)

    def tick(self, now: int) -> None:
        """Let time pass to `now`."""
        self._count(0, now)

    def finish(self) -> None:
        """Finish the file; further calls do nothing."""
        BackgroundWriter.close(self)

    def _begin_part(self, t: int) -> None:
        assert self._rotation is not None
        self._part += 1
        self._part_since = None
        about = {
            **self._metadata,
            topics.PART: str(self._part),
            topics.CUT_START: str(t),
            "attached": "yes",  # for decoders that cannot use the checkpoint
        }
        self.go_on_in(part_path(self._name, self._part), about, t, self._rotation.keep)
        self._put(self._file.forget_state)  # so that the state is written into each part

    def _count(self, frames: int, now: int) -> None:
        if not self.failure and (change := self._throttle.count(frames, now)):
            name, why = change
            self._put(self._file.forget_state)  # so that the first state is written afterwards
            self._put(self._file.log, now, Severity.INFO, why, name)


MOST_BYTES: Final = 1 << 30
PARTS: Final = 16  # so many are there when the oldest goes


def new_name() -> str:
    """A name for a capture that is kept now."""
    return time.strftime("capture-%Y%m%d-%H%M%S.mcap", time.localtime())


class Spool(Recorder):
    """Records into temporary files that are deleted at `close`.

    At most about `most` bytes are kept. Raises CaptureError where they cannot be made. After
    `finish` only `keep` and `close` are called.
    """

    def __init__(
        self,
        start_wall: int,
        metadata: Mapping[str, str],
        most: int = MOST_BYTES,
        shapes: topics.Shapes = topics.CAR_SHAPES,
    ) -> None:
        rotation = Rotation(size=most // PARTS, keep=PARTS)
        try:
            self._folder = tempfile.TemporaryDirectory(
                prefix="bilprov-", ignore_cleanup_errors=True
            )
        except OSError as error:
            raise CaptureError(f"the session cannot be saved: {error.strerror}") from error
        name = Path(self._folder.name, "session.mcap")
        super().__init__(name, start_wall, metadata, rotation, shapes)

    def keep(self, path: Path) -> tuple[Path, ...]:
        """Keep the finished recording under a new name, in its parts if it has several; its files.

        Raises CaptureError if there is a recording of this name, or if it cannot be written; then
        the temporary files stay, and the sentence says where.
        """
        if self.failure:
            raise CaptureError(f"the session cannot be saved: {self.failure}")
        parts = part_paths(self._name)
        kept = [part_path(path, number) for number in parts] if max(parts) > 1 else [path]
        try:
            require_new(path)
            with ExitStack() as written:
                for part, file in zip(parts.values(), kept, strict=True):
                    with part.open("rb") as source, file.open("xb") as out:
                        written.callback(file.unlink)
                        shutil.copyfileobj(source, out, 1 << 20)
                written.pop_all()
        except (CaptureError, OSError) as error:
            folder = Path(tempfile.mkdtemp(prefix="bilprov-kept-"))
            for part in self.paths:
                shutil.move(part, folder)
            why = printable(error.strerror if isinstance(error, OSError) else error)
            raise CaptureError(
                f"{printable(path)} was not written ({why}); the capture is in {folder}"
            ) from error
        return tuple(kept)

    def close(self) -> None:
        """Delete the temporary files; further calls do nothing."""
        super().close()
        self._folder.cleanup()
