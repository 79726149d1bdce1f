"""Into captures and out of them, beside construct and the plain mcap library."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from zlib import crc32

from benchmarks import peers, product, traffic
from benchmarks.commands import ROOT, medians, run
from benchmarks.report import CONSTRUCT, OURS, Goal, Row, times
from benchmarks.setting import Made, Setting, Work
from benchmarks.traffic import reads, waited
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.topics import START_KEY

FAST = 833  # ns of a byte at 12 Mbaud
_CALM = 1_500_000_000  # ns at the protocol's own rate, after which decoded channels have stopped
_PAGE = 4096  # bytes of a read
_SAMPLES = 4  # times the sample for construct, so that opening the file does not count
_CHUNK = 2_000 * 33  # bytes of a chunk of a capture with one message a frame

_KEPT = ROOT / "build/bench"


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
    name_json = f"{CONSTRUCT} + JSON message a frame"
    on_disk: list[float] = []

    def ours() -> float:
        speed, size = _ours(setting, setting.new_file("sniffed.mcap"), before, chunks)
        on_disk.append(size)
        return speed

    def by_json() -> float:
        path = setting.new_file("by_json.mcap")
        return _rate(lambda: peers.json_written(path, setting.construct, few))

    gc.collect()
    gc.freeze()  # what was made for all of them is nobody's garbage
    rates = medians(min(3, setting.sizes.rounds), {OURS: ours, name_json: by_json})
    gc.unfreeze()
    size_of_ours = max(on_disk)
    return work.row(
        work.words,
        "frames/s",
        rates,
        times(rates, name_json, times_construct),
        Goal(f"at most {most_bytes} B a frame", size_of_ours, most_bytes, at_most=True),
    )


sniffed_pages = partial(sniffed, read=_PAGE, times_construct=300, most_bytes=2, byte_time=FAST)
sniffed_bytes = partial(sniffed, read=16, times_construct=20, most_bytes=8)


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


def _ours(
    setting: Setting, path: Path, before: list[Chunk], chunks: list[Chunk]
) -> tuple[float, float]:
    """Frames/s, and bytes in the file for each frame."""
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


def big(setting: Setting) -> Made:
    """A capture as `sniff -w` writes it, made when it is first asked for."""
    if setting.big is None:
        said = setting.said.first(setting.protocol, setting.sizes.replay)
        chunks = [*_calm(setting), *reads(said, setting.protocol, _PAGE, FAST, start=_CALM)]
        frames = sum(len(chunk.data) for chunk in chunks if chunk.direction == "device")
        path = setting.new_file("big.mcap")
        with product.sniffing(path, setting.protocol) as take:
            for chunk in chunks:
                take(chunk)
        setting.big = Made(path, frames, chunks[-1].t)
    return setting.big


def much_waited(setting: Setting) -> Made:
    """A host that waits for each answer, in chunks of 2,000 messages.

    It is kept, since it takes a minute to make.
    """
    about = product.metadata(setting.protocol) | {START_KEY: "0"}
    return _kept(setting, "waited", about=about)


def foreign(setting: Setting) -> Made:
    """A big capture of another program with 64 frames a message, which is kept too."""
    return _kept(setting, "foreign", together=64)


def _kept(
    setting: Setting, name: str, *, together: int = 1, about: dict[str, str] | None = None
) -> Made:
    """A capture by the mcap library that stays for later runs, until other traffic is drawn."""
    frames = setting.sizes.replay * 10 // 17
    drawn = crc32(Path(traffic.__file__).read_bytes() + setting.protocol.source.encode())
    path = _KEPT / f"{name}-{frames}-{drawn:08x}.mcap"
    if not path.exists():
        _KEPT.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.unlink(missing_ok=True)
        with peers.PlainWriter(part, about, _CHUNK if about else 1 << 20) as file:
            for chunk in waited(setting.protocol, frames, together):
                file.write(chunk.direction, chunk.t, chunk.data)
        part.replace(path)
    return Made(path, frames)


def replayed(
    setting: Setting,
    work: Work,
    *,
    words: Callable[[Path], list[str]],
    times_construct: float,
    capture: Callable[[Setting], Made] = big,
) -> Row:
    """A whole command on the big capture.

    Beside it is construct on a sample of the one with reads of 4 KiB, on which it is the fastest.
    """
    made, reads_of_4k = capture(setting), big(setting).path
    ended = run(words(made.path))
    start, most = open_capture(reads_of_4k).start + _CALM, _SAMPLES * setting.sample.frames
    with Path(os.devnull).open("wb") as nowhere:
        out = nowhere if words is product.replayed else None
        read = partial(peers.construct_replayed, reads_of_4k, setting.construct, start, most, out)
        rates = medians(min(3, setting.sizes.rounds), {CONSTRUCT: partial(_rate, read)})
    rates[OURS] = made.frames / ended.seconds
    return work.row(
        _with_frames_of(made, work),
        "frames/s",
        rates,
        times(rates, CONSTRUCT, times_construct),
        Goal("at most 300 MB", ended.memory / 1e6, 300, at_most=True),
    )


def _with_frames_of(made: Made, work: Work) -> str:
    return f"{made.frames / 1e6:.3g} M frames, {work.words}"


to_statistics = partial(replayed, words=product.statistics, times_construct=200)
to_jsonl = partial(replayed, words=product.replayed, times_construct=10)
waited_to_statistics = partial(to_statistics, times_construct=40, capture=much_waited)
waited_to_jsonl = partial(to_jsonl, times_construct=8, capture=much_waited)


def foreign_to_statistics(setting: Setting, work: Work) -> Row:
    """Another program's capture to statistics, beside the big one with its reads of 4 KiB."""
    made = {OURS: foreign(setting), "reads of 4 KiB": big(setting)}

    def measured(one: Made) -> float:
        return one.frames / run(product.statistics(one.path)).seconds

    works = {name: partial(measured, one) for name, one in made.items()}
    rates = medians(min(3, setting.sizes.rounds), works)
    words, goal = _with_frames_of(made[OURS], work), times(rates, "reads of 4 KiB", 0.8)
    return work.row(words, "frames/s", rates, goal)


def _rate(work: Callable[[], int]) -> float:
    begun = time.perf_counter()
    return work() / (time.perf_counter() - begun)
