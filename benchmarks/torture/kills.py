"""`sniff` is killed at any moment: how much of what it was given before is not in its capture.

SIGKILL comes at a moment drawn by the seed, while as many bytes as 115,200 baud carry are written
into its port. At most the last 0.1 s may be lost, and as long as `sniff` waited for a processor
meanwhile, which Linux counts. What is kept must be what was fed, byte by byte.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from random import Random
from statistics import median
from subprocess import TimeoutExpired
from typing import NamedTuple, TypeAlias

from benchmarks.lines import wires
from benchmarks.torture.harm import Harm, Row, tracked
from benchmarks.torture.unplugged_taps import Listener, heard
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture

PROMISED = 0.1  # s, at most so much is lost
_STEP = 0.005  # s between two writes
_AFTER = 0.3, 2.5  # s of feeding after which the kill comes
_BYTES = 50  # of a write
_FORMS = "two taps", "two taps, --rotate", "--bridge"


# When so many bytes had been written, and how long (s) `sniff` had waited for a processor by then.
Moment: TypeAlias = tuple[float, int, float]


class Kill(NamedTuple):
    """What one kill came to: seconds of traffic lost, and waited meanwhile; what is wrong."""

    lost: float
    waited: float
    wrong: str = ""


def killed(form: str, seed: int) -> Kill:
    """Let `sniff` record in one of the forms, kill it, and see what is in its capture."""
    draw = Random(f"{seed} {form}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host, device = stack.enter_context(wires())
        ports = ["--bridge", device.name] if form == "--bridge" else [host.name, device.name]
        rotated = ["--rotate", "1s"] if "--rotate" in form else []
        sniff = Listener(stack, folder, *ports, *rotated, "--yes")
        port = host.master
        if form == "--bridge":
            port = os.open(sniff.served, os.O_RDWR | os.O_NOCTTY)
            stack.callback(os.close, port)
        time.sleep(0.3)  # for the ports, which are opened about then
        pid, until = sniff.process.pid, time.monotonic() + draw.uniform(*_AFTER)
        data, moments = _feed(port, draw, until, pid)
        sniff.process.send_signal(signal.SIGSTOP)  # for the last that Linux counts of it
        end = time.monotonic()
        os.waitpid(pid, os.WUNTRACED)
        moments.append((end, len(data), _waited(pid)))
        sniff.process.kill()
        sniff.process.wait()
        return judged(sniff.capture, data, moments)


def _feed(port: int, draw: Random, until: float, pid: int) -> tuple[bytes, list[Moment]]:
    """Write at a steady rate until that moment; returns what was written, and when."""
    data, moments = bytearray(), []
    due = time.monotonic()
    while due < until:
        block = draw.randbytes(_BYTES)
        waited = _waited(pid)
        with suppress(BlockingIOError):  # what is not taken is not fed
            data += block[: os.write(port, block)]
        moments.append((time.monotonic(), len(data), waited))
        due += _STEP
        time.sleep(max(0.0, due - time.monotonic()))
    return bytes(data), moments


def _waited(pid: int) -> float:
    """How long (s) the threads of a process could have run, but had no processor."""
    counts = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(count.read_text().split()[1]) for count in counts) / 1e9


def judged(path: Path, data: bytes, moments: list[Moment]) -> Kill:
    """What is in the capture of a `sniff` that was killed at the last moment, beside its `data`."""
    end, _, waited = moments[-1]
    try:
        capture, kept = open_capture(path), heard(path)["host"]
        damage = [*capture.damage, *(what for _, _, what in capture.losses())]
    except CaptureError as error:
        return Kill(end - moments[0][0], 0.0, f"unreadable: {error}")
    if not data or data[: len(kept)] != kept:
        return Kill(0.0, 0.0, "the port took no byte, or a byte is wrong or there twice")
    first = next((one for one in moments if one[1] > len(kept)), moments[-1])
    lost, waited = end - first[0], waited - first[2]
    if damage:
        return Kill(lost, waited, f"it is damaged: {damage[0]}")
    said = f"{lost:.3f} s are lost, it waited for a processor for {waited:.3f} s"
    return Kill(lost, waited, said if lost > PROMISED + waited else "")


def _measure(runs: int, seed: int) -> list[Row]:
    held: dict[str, list[Kill]] = {form: [] for form in _FORMS}
    for run in tracked(range(runs), runs):
        form = _FORMS[run % len(_FORMS)]
        try:
            held[form].append(killed(form, seed + run))
        except (OSError, ValueError, TimeoutExpired) as error:
            held[form].append(Kill(0.0, 0.0, f"sniff did not record: {error}"))
    return [_row(form, kills) for form, kills in held.items() if kills]


def _row(form: str, kills: list[Kill]) -> Row:
    lost = [one.lost for one in kills]
    return Row(
        f"`sniff -w` of {form} killed by SIGKILL while traffic comes",
        len(kills),
        f"the last {median(lost) * 1e3:.0f} ms, {max(lost) * 1e3:.0f} ms at most (it waited for a "
        f"processor for {max(one.waited for one in kills) * 1e3:.0f} ms of that at most)",
        tuple(one.wrong for one in kills if one.wrong),
    )


HARM = Harm("kills", "a recording is killed at any moment", 200, _measure)
