"""Into captures and out of them, beside construct, the plain mcap library and the C loop."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import peers, product
from benchmarks.commands import bilprov_words, medians, run
from benchmarks.report import C_LOOP, CONSTRUCT, Goal, Row
from benchmarks.setting import Made, Setting, Work
from benchmarks.traffic import reads
from bilprov.captures.schemas import Chunk

FAST = 833  # ns of a byte at 12 Mbaud
_CALM = 1_500_000_000  # ns at the protocol's own rate, after which decoded channels have stopped
_PAGE = 4096  # bytes of a read
_SAMPLES = 4  # times the sample for construct, so that opening the file does not count
_TRIED = 20  # reads of a capture that is made, after which it is known how long it takes
_LONGEST = 24  # times the patience of a row that a whole command may take

Figures = tuple[float, float]
"""Frames/s, and bytes in the file for each frame."""


def sniffed(
    setting: Setting,
    work: Work,
    *,
    read: int,
    times_construct: float,
    most_bytes: float,
    byte_time: int = 0,
) -> Row:
    """What `sniff -w` does with reads of so many bytes, at the protocol's own rate unless given.

    Before the clock runs, two seconds at the protocol's own rate have passed.
    """
    before = _calm(setting)
    size = setting.sizes.capture if read == _PAGE else setting.sizes.capture // 8
    said = setting.said.first(setting.protocol, size)
    byte_time = byte_time or setting.byte_time
    chunks = list(reads(said, setting.protocol, read, byte_time, start=_CALM))
    few = _with_frames(chunks, setting.sample.frames)
    on_disk: dict[str, float] = {}
    name_json, name_raw = f"{CONSTRUCT} + JSON message a frame", "raw chunks alone"
    works: dict[str, Callable[[Path], Figures]] = {
        "bilprov": lambda path: _ours(setting, path, before, chunks),
        name_json: lambda path: _peer(
            path, lambda: peers.json_written(path, setting.construct, few)
        ),
        name_raw: lambda path: _peer(path, lambda: peers.raw_written(path, chunks)),
    }

    def measured(name: str) -> float:
        speed, on_disk[name] = works[name](setting.new_file("sniffed.mcap"))
        return speed

    gc.collect()
    gc.freeze()  # what was made for all of them is nobody's garbage
    rounds = min(3, setting.sizes.rounds)
    rates = medians(rounds, {name: lambda name=name: measured(name) for name in works})  # type: ignore[misc]
    gc.unfreeze()
    ours = rates.pop("bilprov")
    figures = {"B a frame on disk": on_disk.pop("bilprov")}
    beside = {f"B a frame ({name})": size for name, size in on_disk.items()}
    return Row(
        work.name,
        work.words,
        "frames/s",
        ours,
        rates,
        figures,
        beside,
        (
            Goal(f"{times_construct} x {name_json}", ours / rates[name_json], times_construct),
            Goal(f"at most {most_bytes} B a frame", figures["B a frame on disk"], most_bytes, True),
        ),
    )


def _calm(setting: Setting) -> list[Chunk]:
    """A full line of the protocol's own, for as long as decoded channels may go on."""
    said = setting.said.first(setting.protocol, _CALM // setting.byte_time)
    return list(reads(said, setting.protocol, 16, setting.byte_time))


def _with_frames(chunks: list[Chunk], frames: int) -> list[Chunk]:
    """The first chunks in which at least so many frames are answered."""
    answered = 0
    for place, chunk in enumerate(chunks):
        answered += len(chunk.data) if chunk.direction == "device" else 0
        if answered >= frames:
            return chunks[: place + 1]
    return chunks


def _ours(setting: Setting, path: Path, before: list[Chunk], chunks: list[Chunk]) -> Figures:
    frames = 0
    with product.sniffing(path, setting.protocol) as take:
        for chunk in before:
            take(chunk)
        size = path.stat().st_size
        begun = time.perf_counter()
        for chunk in chunks:
            take(chunk)
            if chunk.direction == "device":
                frames += len(chunk.data)
                if time.perf_counter() - begun > setting.sizes.patience:
                    break
    return frames / (time.perf_counter() - begun), (path.stat().st_size - size) / frames


def _peer(path: Path, write: Callable[[], int]) -> Figures:
    begun = time.perf_counter()
    frames = write()
    return frames / (time.perf_counter() - begun), path.stat().st_size / frames


def small(setting: Setting) -> Made:
    """The small capture of this run."""
    return _made(setting, "small", setting.sizes.replay_sample)


def big(setting: Setting) -> Made:
    """The big capture of this run."""
    return _made(setting, "big", setting.sizes.replay)


def _made(setting: Setting, name: str, size: int) -> Made:
    """A capture as `sniff -w` writes it, made when it is first asked for."""
    if name not in setting.made:
        said = setting.said.first(setting.protocol, size)
        before = _calm(setting)
        chunks = [*before, *reads(said, setting.protocol, _PAGE, FAST, start=_CALM)]
        frames = sum(len(chunk.data) for chunk in chunks if chunk.direction == "device")
        path, note = setting.new_file(f"{name}.mcap"), ""
        if not _sniffed_in_time(setting, path, chunks, len(before)):
            note = "a capture of raw chunks alone: sniffing would take too long to make it"
            with product.logging(setting.new_file(path.name), setting.protocol) as take:
                for chunk in chunks:
                    take(chunk)
        setting.made[name] = Made(path, frames, chunks[-1].t, note)
    return setting.made[name]


def _sniffed_in_time(setting: Setting, path: Path, chunks: list[Chunk], calm: int) -> bool:
    """Make a capture as `sniff -w` does, if that does not take too long; returns whether it did."""
    longest = _LONGEST * setting.sizes.patience
    with product.sniffing(path, setting.protocol) as take:
        for chunk in chunks[:calm]:
            take(chunk)
        begun = time.perf_counter()
        for place, chunk in enumerate(chunks[calm:], 1):
            take(chunk)
            passed = time.perf_counter() - begun
            if place == _TRIED and passed / place * len(chunks) > longest:
                return False
    return True


def to_statistics(setting: Setting, work: Work) -> Row:
    """A capture to its statistics."""
    return _replayed(setting, work, product.statistics, None, 200)


def to_jsonl(setting: Setting, work: Work) -> Row:
    """A capture to JSON lines that nobody reads."""
    made = small(setting)
    told = run(bilprov_words(*product.replayed(made.path)), keep=True).output.count("\n")
    if told < 2 * made.frames:
        raise RuntimeError(f"{made.frames} frames and their answers gave {told} lines")
    with Path(os.devnull).open("wb") as nowhere:
        return _replayed(setting, work, product.replayed, nowhere, 10)


def _replayed(
    setting: Setting,
    work: Work,
    words: Callable[[Path], list[str]],
    out: object,
    times_construct: float,
) -> Row:
    """The whole command, on the big capture unless it takes too long; construct on a sample."""
    made, few = big(setting), small(setting)
    note = made.note
    little = run(bilprov_words(*words(few.path)))
    longest = _LONGEST * setting.sizes.patience
    if little.seconds * made.frames / few.frames > longest:
        note = f"{made.frames / 1e6:.3g} M frames would take over {longest:.0f} s"
        made, ended = few, little
    else:
        ended = run(bilprov_words(*words(made.path)))
    start, most = product.capture_start(made.path) + _CALM, _SAMPLES * setting.sample.frames
    speed = {
        CONSTRUCT: lambda: _rate(
            lambda: peers.construct_replayed(made.path, setting.construct, start, most, out)
        )
    }
    if setting.has_ceiling():
        speed[f"mcap + {C_LOOP}"] = lambda: _rate(
            lambda: peers.ceiling_replayed(made.path, setting.ceiling)
        )
    rates = medians(min(3, setting.sizes.rounds), speed)
    return Row(
        work.name,
        f"{made.frames / 1e6:.3g} M frames, {work.words}",
        "frames/s",
        made.frames / ended.seconds,
        rates,
        {"MB at peak": ended.memory / 1e6, "MB with the small capture": little.memory / 1e6},
        goals=(
            Goal(
                f"{times_construct} x {CONSTRUCT}",
                made.frames / ended.seconds / rates[CONSTRUCT],
                times_construct,
            ),
            Goal("at most 300 MB", ended.memory / 1e6, 300, True),
        ),
        note=note,
    )


def _rate(work: Callable[[], int]) -> float:
    begun = time.perf_counter()
    return work() / (time.perf_counter() - begun)
