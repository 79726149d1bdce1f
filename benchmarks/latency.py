"""How late: from a byte on the line to its JSON line, and what a bridge adds to a round trip."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from statistics import quantiles
from subprocess import PIPE, Popen

from benchmarks import lines, product
from benchmarks.commands import bilprov_words, started
from benchmarks.report import OURS, Goal, Row
from benchmarks.setting import Setting, Work
from benchmarks.traffic import Exchange, blocks

_PAUSE = 0.002  # s between two frames: the program waits for the next one
_PATIENCE = 5.0  # s
_WARM = 20  # exchanges that do not count


def to_json_line(setting: Setting, work: Work) -> Row:
    """A frame's last byte to its line, beside a bare loop that takes the other turns."""
    exchanges = _exchanges(setting)
    with (
        lines.wires() as on,
        lines.wires() as beside,
        started(product.sniffed(*_names(on), "jsonl"), stdout=PIPE) as ours,
        started(
            [sys.executable, "-m", "benchmarks.bare_reader", *_names(beside)], stdout=PIPE
        ) as bare,
    ):
        for process, wire in ((ours, on), (bare, beside)):
            lines.await_listener(process, wire)
        took = _in_turns(
            exchanges,
            lambda exchange: _to_line(ours, on, exchange),
            lambda exchange: _to_line(bare, beside, exchange),
        )
    (p50, p99), (bare50, bare99) = map(_p50_p99, took)
    return work.row(
        f"{work.words}, p50",
        "us",
        {OURS: p50, "select + read + json": bare50},
        Goal("p50 at most 1.3 x the bare loop's", p50 / bare50, 1.3, at_most=True),
        Goal("p99 at most 1.3 x the bare loop's", p99 / bare99, 1.3, at_most=True),
    )


def through_a_bridge(setting: Setting, work: Work) -> Row:
    """A frame to the device and its answer back, through a bridge and over a pty alone."""
    exchanges = _exchanges(setting)
    with (
        lines.wires() as on,
        started(
            bilprov_words("sniff", "--bridge", on.device.name, "--format", "jsonl"), stderr=PIPE
        ) as bridge,
    ):
        served = bridge.stderr.readline().decode().strip() if bridge.stderr else ""
        if not served.startswith("/dev/"):
            raise RuntimeError(f"the bridge says {served!r}, not its pty")
        bridged = os.open(served, os.O_RDWR | os.O_NOCTTY)
        direct = os.open(on.host.name, os.O_RDWR | os.O_NOCTTY)
        try:
            time.sleep(0.3)
            took = _in_turns(
                exchanges,
                lambda exchange: _round_trip(bridged, on.device.master, exchange),
                lambda exchange: _round_trip(direct, on.host.master, exchange),
            )
        finally:
            os.close(bridged)
            os.close(direct)
    (p50, p99), (direct50, direct99) = map(_p50_p99, took)
    return work.row(
        f"{work.words}, p50",
        "us",
        {OURS: p50 - direct50},
        Goal("at most + 60 us at p50", p50 - direct50, 60, at_most=True),
        Goal("at most + 200 us at p99", p99 - direct99, 200, at_most=True),
    )


def _exchanges(setting: Setting) -> list[Exchange]:
    return next(blocks(setting.protocol, seed=3))[: setting.sizes.exchanges]


def _names(on: lines.Wires) -> tuple[str, str]:
    return on.host.name, on.device.name


def _in_turns(
    exchanges: list[Exchange], *works: Callable[[Exchange], float]
) -> tuple[list[float], ...]:
    """The times (us) of each work over the same exchanges, in turns, once all are warm."""
    took: tuple[list[float], ...] = tuple([] for _ in works)
    for place, exchange in enumerate([*exchanges[:_WARM], *exchanges]):
        for work, times in zip(works, took, strict=True):
            time.sleep(_PAUSE)
            found = work(exchange)
            if place >= _WARM:
                times.append(found * 1e6)
    return took


def _to_line(process: Popen[bytes], on: lines.Wires, exchange: Exchange) -> float:
    frame, answer = exchange
    assert process.stdout is not None
    begun = time.perf_counter()
    on.host.write_some(frame)
    _received(process.stdout.fileno(), b"\n")
    took = time.perf_counter() - begun
    on.device.write_some(answer)
    _received(process.stdout.fileno(), b"\n")
    return took


def _round_trip(host: int, device: int, exchange: Exchange) -> float:
    frame, answer = exchange
    begun = time.perf_counter()
    os.write(host, frame)
    heard = b""
    while len(heard) < len(frame):
        heard += _received(device)
    os.write(device, answer)
    if _received(host) != answer or heard != frame:
        raise RuntimeError("other bytes came than were sent")
    return time.perf_counter() - begun


def _received(descriptor: int, end: bytes = b"") -> bytes:
    """What comes next, up to `end`. Raises RuntimeError if nothing does."""
    heard = b""
    while not heard or not heard.endswith(end):
        if not select.select([descriptor], [], [], _PATIENCE)[0]:
            raise RuntimeError("nothing came")
        heard += os.read(descriptor, 1 << 16)
    return heard


def _p50_p99(times: list[float]) -> tuple[float, float]:
    cut = quantiles(times, n=100)
    return cut[49], cut[98]
