"""How fast `replay` is on a terminal with the big capture: first page, keys, a filter, memory."""

from __future__ import annotations

import os
import re
import select
import time
from pathlib import Path

from benchmarks import captures, lines, product
from benchmarks.commands import started
from benchmarks.report import OURS, Goal, Row
from benchmarks.setting import Setting, Work

_END, _HOME, _PAGE_UP, _PAGE_DOWN = b"\x1b[F", b"\x1b[H", b"\x1b[5~", b"\x1b[6~"
_KEYS = (_END, _PAGE_UP, _HOME, _PAGE_DOWN, b"n", _END, b"N", b"t")
_FILTER = b"/faulty and latency > 100us\r"
_STILL = 0.6  # s after which nothing more is drawn: figures are, twice a second


def browse(setting: Setting, work: Work) -> Row:
    """The whole command over the big capture, in a process of its own."""
    made = captures.big(setting)
    patience, rows = 40 * setting.sizes.patience + 20, 2 * made.frames
    ours, theirs = lines.opened_terminal()
    with os.fdopen(ours, "rb+", 0), os.fdopen(theirs, "rb+", 0):
        words, begun = product.browsed(made.path), time.perf_counter()
        with started(words, stdin=theirs, stdout=theirs, stderr=theirs) as process:
            first_page = _drawn(ours, patience, "→") - begun
            _drawn(ours, patience, f"{rows // 1000:,},")  # until all is read
            _drawn(ours, patience)
            slowest = max(_pressed(ours, key, patience) for key in _KEYS)
            filtered = _pressed(ours, _FILTER, patience, r"[\d,]+ of [\d,]+")
            status = Path(f"/proc/{process.pid}/status").read_text()
            memory = int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6  # its peak
    return work.row(
        f"{work.words}, {rows / 1e6:.3g} M rows",
        "s",
        {OURS: first_page},
        Goal("first page in 1.5 s", first_page, 1.5, at_most=True),
        Goal("a key in 100 ms", slowest * 1e3, 100, at_most=True),
        Goal("a filter in 1 s", filtered, 1, at_most=True),
        Goal("500 MB", memory, 500, at_most=True),
    )


def _pressed(terminal: int, keys: bytes, patience: float, words: str = "") -> float:
    """How long (s) it takes from a key to the words, or to all that is drawn for it."""
    begun = time.perf_counter()
    os.write(terminal, keys)
    return _drawn(terminal, patience, words) - begun


def _drawn(terminal: int, patience: float, words: str = "") -> float:
    """When (s) a pattern was drawn; without one, when the last was drawn before it was still.

    Raises TimeoutError if it takes longer than `patience` (s).
    """
    last, output = time.perf_counter(), b""
    give_up = last + patience
    while time.perf_counter() < give_up:
        if select.select([terminal], [], [], _STILL)[0]:
            output += os.read(terminal, 1 << 16)
            last = time.perf_counter()
            if words and re.search(words.encode(), output):
                return last
        elif not words:
            return last
    raise TimeoutError(f"it took longer than {patience:.0f} s")
