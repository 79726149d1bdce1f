"""The disk is full as `sniff --rotate` closes a part: the line goes on, and one sentence says so.

What stands for a full disk is a limit on the size of files. It is set while `sniff` runs, to a size
drawn by the seed: what has been written has its place, and of the end of the part a share.
"""

from __future__ import annotations

import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from random import Random

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.unplugged_taps import Bridge, Listener, Plug, Talk, heard, until
from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter

_ROTATE = 1.0  # s
_FRAMES = 20  # instructions before the disk is full, at most, and after
_PAUSE = 0.002  # s between instructions at taps
FORMS = ("two taps", "--bridge")


@cache
def _end() -> int:
    """How many bytes the end of a part has, at least."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "part.mcap"
        with CaptureWriter(path, start_wall=0, metadata={}, version="0") as part:
            part.chunk(Chunk(0, "host", b" "))
            part.flush()
            before = part.size
        return path.stat().st_size - before


def filled(form: str, seed: int) -> str:
    """Let `sniff` find the disk full as it closes a part: what is wrong, "" if nothing."""
    draw = Random(f"{seed} {form}")
    talk = Talk(draw)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plugs = [Plug(folder / name) for name in ("host", "device")]
        for plug in plugs:
            stack.callback(plug.pull)
        ports = [str(plug.path) for plug in plugs]
        if form == "--bridge":
            ports = ["--bridge", ports[1]]
        sniff = Listener(stack, folder, *ports, "--rotate", f"{_ROTATE:g}s")
        exchanges: Callable[[int], None] = partial(_tapped, plugs, talk)
        if form == "--bridge":
            exchanges = Bridge(stack, sniff, plugs[1], talk).exchanges
        try:
            wrong = _wrong(sniff, talk, exchanges, draw)
        except (TimeoutError, subprocess.TimeoutExpired, LinkError) as error:
            sniff.process.kill()
            wrong = f"{type(error).__name__}: {error}"
        if "Traceback" in sniff.told:
            wrong = f"a traceback, {wrong}"
        return wrong and f"seed {seed}: {wrong}: {sniff.told.strip()[-200:]}"


def _tapped(plugs: list[Plug], talk: Talk, count: int) -> None:
    """Send instructions and their answers into two taps."""
    host, device = plugs
    for _ in range(count):
        frame, answer = talk.next()
        host.write(frame)
        talk.wrote("host", frame)
        device.write(answer)
        talk.wrote("device", answer)
        time.sleep(_PAUSE)


def _wrong(sniff: Listener, talk: Talk, exchanges: Callable[[int], None], draw: Random) -> str:
    """Fill the disk, go on on the line, and see what is wrong."""
    exchanges(draw.randint(1, _FRAMES))
    before = dict(talk.written)
    until(lambda: all(sniff.has(*said) for said in before.items()), "not all is captured")
    parts = kept_parts(sniff.capture)
    size = parts[max(parts)].stat().st_size + draw.randrange(_end())
    resource.prlimit(sniff.process.pid, resource.RLIMIT_FSIZE, (size, size))
    time.sleep(1.2 * _ROTATE)
    exchanges(_FRAMES)
    until(lambda: "disk full" in sniff.told or sniff.ended, "nothing says that the disk is full")
    exchanges(_FRAMES)
    if sniff.ended:
        return "it ended"
    code = sniff.end()
    if code != 2:
        return f"exit {code}, allowed is 2"
    try:
        kept = heard(sniff.capture)
    except CaptureError as error:
        return f"the capture cannot be read: {error}"
    for tap, data in kept.items():
        if not (talk.written[tap].startswith(data) and data.startswith(before[tap])):
            return f"{tap}: {len(before[tap])} bytes were captured, {len(data)} are there"
    return ""


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Fill the disk of each form so often, two at a time; a row for each."""
    rows = []
    for form in FORMS:
        with ThreadPoolExecutor(2) as pool:
            came = []
            for one in pool.map(partial(filled, form), range(seed, seed + runs)):
                came.append(one)
                progress(int(form == FORMS[-1]))
        wrong = tuple(filter(None, came))
        rows.append(
            Row(
                f"the disk full as `sniff --rotate` of {form} closes a part",
                runs,
                f"{len(wrong)} lost what had been recorded, or the line",
                wrong,
            )
        )
    return rows


HARM = Harm("seams", "disks that are full as a part of a recording is closed", 50, _measure)
