"""Captures that are changed inside of their records: each is refused, or read, mended and written.

What a use fails on is written to build/torture; in `corpus` it becomes a test.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

from benchmarks.commands import ROOT
from benchmarks.torture.capture_mutator import changed_capture
from benchmarks.torture.capture_seeds import foreign_captures, loose_capture, own_captures
from benchmarks.torture.capture_uses import edited, examined, exported, mended
from benchmarks.torture.guard import Failed, folder, guarded, watched
from benchmarks.torture.harm import Harm, Row, tracked
from bilprov.captures.errors import CaptureError

CORPUS = tuple((Path(__file__).parent / "corpus").iterdir())
"""What was once failed on."""
USES: dict[str, Callable[[Path], None]] = {
    "read": examined,
    "mended": mended,
    "exported": exported,
    "edited": edited,
}
_SHARES = ("read", "read", "read", "read", "mended", "exported", "edited")
_OUT = ROOT / "build" / "torture"


def used(use: str, data: bytes) -> bool | Failed:
    """Whether a file with these bytes is taken, and not refused; or how it fails."""
    path = folder() / "changed.mcap"
    path.write_bytes(data)

    def act() -> bool:
        try:
            USES[use](path)
        except CaptureError:
            return False
        return True

    return guarded(act)


def _measure(runs: int, seed: int) -> list[Row]:
    """Change so many captures; a row for each use."""
    draw = Random(seed)
    seeds = [*own_captures(), *foreign_captures(), loose_capture()]
    count, taken = Counter[str](), Counter[str]()
    wrong: dict[str, dict[Failed, str]] = {use: {} for use in USES}
    with watched():
        for run in tracked(range(runs), runs):
            use, data = _SHARES[run % len(_SHARES)], changed_capture(draw, seeds)
            came = used(use, data)
            count[use] += 1
            taken[use] += came is True
            if isinstance(came, Failed) and came not in wrong[use]:
                wrong[use][came] = f"{came}: {_kept(use, data)}"
    return [
        Row(
            f"captures changed inside, {use}",
            count[use],
            f"{taken[use]:,} taken, {count[use] - taken[use]:,} refused with a sentence",
            tuple(wrong[use].values()),
        )
        for use in USES
    ]


def _kept(use: str, data: bytes) -> Path:
    """Keep what was failed on; gives its file."""
    _OUT.mkdir(parents=True, exist_ok=True)
    file = _OUT / f"{use}-{zlib.crc32(data):08x}.mcap"
    file.write_bytes(data)
    return file


HARM = Harm("changes", "captures changed inside of their records", 100_000, _measure)
