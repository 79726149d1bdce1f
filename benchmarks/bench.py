"""The command: measures every row beside its peers in one run, and prints the table.

`python -m benchmarks.bench [--only NAME] [--publish]`. With --publish a run of all
rows also renews the table in docs/performance.md. Exit status: 1 if a row failed; no figure is
asserted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from fnmatch import fnmatch
from pathlib import Path

from benchmarks import browse, captures, decoding, first_lines, framed, latency, live
from benchmarks.commands import ROOT, tell
from benchmarks.report import Row, as_markdown, between_markers, cells, machine
from benchmarks.setting import FULL, Setting, Work

_PAGE = ROOT / "docs/performance.md"
_SNIFF = "`sniff -w`'s path, both directions"
_FOREIGN = "another program's capture, 64 frames a message,"
WORKS = (
    Work("columns", "bytes to verdict and state columns", decoding.columns),
    Work("records", "the same to Python records, one by one, cold", decoding.records),
    Work("modbus-rtu", "Modbus RTU to columns, both directions", framed.modbus_rtu),
    Work("dynamixel1", "DYNAMIXEL to columns, both directions", framed.dynamixel1),
    Work("capture-4k", f"{_SNIFF}, reads of 4 KiB", captures.sniffed_pages),
    Work("capture-16", f"{_SNIFF}, reads of 16 bytes", captures.sniffed_bytes),
    Work("replay-statistics", "capture to statistics", captures.to_statistics),
    Work("replay-jsonl", "capture to `jsonl`", captures.to_jsonl),
    Work("waited-statistics", "waited traffic to statistics", captures.waited_to_statistics),
    Work("waited-jsonl", "waited traffic to `jsonl`", captures.waited_to_jsonl),
    Work("foreign-statistics", f"{_FOREIGN} to statistics", captures.foreign_to_statistics),
    Work("seek", "`replay --start` near the end, to the first line", first_lines.seek),
    Work("browse", "`replay` on a screen to its first page", browse.browse),
    Work("line-jsonl", "a full line, `jsonl`", live.full_line),
    Work("line-write", "a full line, `jsonl` and `-w`", live.full_line_written),
    Work("line-screen", "a full line, live screen and `-w`", live.full_line_on_screen),
    Work("fast-quiet", "1.2 MB/s, `-w` and `--quiet`", live.fast_line),
    Work("fast-screen", "1.2 MB/s, `-w` and the live screen", live.fast_line_on_screen),
    Work("latency", "byte to JSON line", latency.to_json_line),
    Work("bridge", "round trip added by a bridge", latency.through_a_bridge),
    Work("help", "`--help`", first_lines.help_page),
    Work("decode", "`decode 2111` to its line", first_lines.decoded),
)


def main() -> int:
    """Measure the rows that are asked for, and print the table; returns 1 if one failed."""
    options = _options()
    on, rows = machine(), []
    with tempfile.TemporaryDirectory(prefix="bilprov-bench-") as folder:
        setting = Setting(Path(folder), FULL)
        for work in WORKS:
            if fnmatch(work.name, options.only):
                rows.append(measured(setting, work))
    tell(as_markdown(rows, on))
    if options.publish and len(rows) == len(WORKS):
        text = _PAGE.read_text(encoding="utf-8")
        _PAGE.write_text(between_markers(text, as_markdown(rows, on)), encoding="utf-8")
        tell(f"renewed: the table in {_PAGE}")
    return int(any(row.ours is None for row in rows))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="*", metavar="NAME", help="rows by name, * for any")
    parser.add_argument("--publish", action="store_true", help="renew docs/performance.md")
    options = parser.parse_args()
    if not any(fnmatch(work.name, options.only) for work in WORKS):
        parser.error(f"no row is {options.only}: there are {', '.join(w.name for w in WORKS)}")
    return options


def measured(setting: Setting, work: Work) -> Row:
    """Measure one row and tell it; what breaks ends that row alone."""
    begun = time.monotonic()
    try:
        row = work.measure(setting, work)
    except Exception as error:  # the other rows are still worth their time
        row = Row(work.name, work.words, note=f"{type(error).__name__}: {error}")
    shown = "; ".join(filter(None, cells(row)[1:]))
    tell(f"{work.name:18} {shown} [{time.monotonic() - begun:.1f} s]")
    return row


if __name__ == "__main__":
    sys.exit(main())
