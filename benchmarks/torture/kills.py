"""`sniff` is killed at any moment: how much of what it was given before is not in its capture.

SIGKILL comes at a moment drawn by the seed, while bytes are written into its port at a steady rate.
At most the last 0.1 s may be lost, and as long as this machine let its processes wait meanwhile:
that is measured by how late the feeder itself was. What is kept must be what was fed, byte by byte.
"""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from random import Random
from statistics import median
from subprocess import TimeoutExpired
from typing import NamedTuple

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.unplugged_taps import Listener
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk

PROMISED = 0.1  # s, at most so much is lost
_STEP = 0.005  # s between two writes
_AFTER = 0.3, 2.5  # s of feeding after which the kill comes
_BYTES = {"two taps": 50, "two taps, --rotate": 1000, "--bridge": 50}  # of a write


class Fed(NamedTuple):
    """What was written into the port: all bytes, when so many were there, the longest delay (s)."""

    data: bytes
    moments: list[tuple[float, int]]
    late: float


class Kill(NamedTuple):
    """What one kill came to: seconds of traffic lost, how late the feeder was, what is wrong."""

    lost: float
    late: float
    wrong: str = ""


def killed(form: str, seed: int) -> Kill:
    """Let `sniff` record in one of the forms, kill it, and see what is in its capture."""
    draw = Random(f"{seed} {form}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host, device = open_pty(), open_pty()
        stack.callback(host.close)
        stack.callback(device.close)
        ports = ["--bridge", device.name] if form == "--bridge" else [host.name, device.name]
        rotated = ["--rotate", "100kB"] if "--rotate" in form else []
        sniff = Listener(stack, folder, *ports, *rotated, "--yes")
        port = host.master
        if form == "--bridge":
            port = os.open(sniff.served, os.O_RDWR | os.O_NOCTTY)
            stack.callback(os.close, port)
        time.sleep(0.3)  # for the ports, which are opened about then
        fed = _feed(port, draw, time.monotonic() + draw.uniform(*_AFTER), _BYTES[form])
        sniff.process.kill()
        end = time.monotonic()
        sniff.process.wait()
        return judged(sniff.capture, fed, end)


def _feed(port: int, draw: Random, until: float, size: int) -> Fed:
    """Write at a steady rate until that moment."""
    data, moments, late = bytearray(), [], 0.0
    due = time.monotonic()
    while due < until:
        late = max(late, time.monotonic() - due)
        block = draw.randbytes(size)
        with suppress(BlockingIOError):  # what is not taken is not fed
            data += block[: os.write(port, block)]
        moments.append((time.monotonic(), len(data)))
        due += _STEP
        time.sleep(max(0.0, due - time.monotonic()))
    return Fed(bytes(data), moments, late)


def judged(path: Path, fed: Fed, end: float) -> Kill:
    """What is in the capture of a `sniff` that was killed at `end`, beside what it was fed."""
    try:
        capture = open_capture(path)
        events = capture.events()
        sides = [one for one in events if isinstance(one, Chunk) and one.direction == "host"]
        damage = [*capture.damage, *(loss.what for loss in capture.losses())]
    except CaptureError as error:
        return Kill(end - fed.moments[0][0], fed.late, f"unreadable: {error}")
    kept = b"".join(chunk.data for chunk in sides)
    if not fed.data:
        return Kill(0.0, fed.late, "the port took no byte")
    if fed.data[: len(kept)] != kept:
        return Kill(0.0, fed.late, "a byte is wrong or there twice")
    lost = next((end - at for at, count in fed.moments if count > len(kept)), 0.0)
    if damage:
        return Kill(lost, fed.late, f"it is damaged: {damage[0]}")
    much = lost > PROMISED + fed.late
    said = f"{lost:.3f} s are lost, the feeder was {fed.late * 1e3:.0f} ms late"
    return Kill(lost, fed.late, said if much else "")


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    forms = list(_BYTES)
    held: dict[str, list[Kill]] = {form: [] for form in forms}
    for run in range(runs):
        form = forms[run % len(forms)]
        try:
            held[form].append(killed(form, seed + run))
        except (OSError, ValueError, TimeoutExpired) as error:
            held[form].append(Kill(0.0, 0.0, f"sniff did not record: {error}"))
        progress(1)
    return [_row(form, kills) for form, kills in held.items() if kills]


def _row(form: str, kills: list[Kill]) -> Row:
    lost = [one.lost for one in kills]
    return Row(
        f"`sniff -w` of {form} killed by SIGKILL while traffic comes",
        len(kills),
        f"the last {median(lost) * 1e3:.0f} ms, {max(lost) * 1e3:.0f} ms at most (the feeder was "
        f"{max(one.late for one in kills) * 1e3:.0f} ms late at most)",
        tuple(one.wrong for one in kills if one.wrong),
    )


HARM = Harm("kills", "a recording is killed at any moment", 200, _measure)
