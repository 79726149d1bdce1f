"""The command: measures every row beside its peers in one run, and writes what came out.

`python -m benchmarks.bench [--quick] [--only NAME] [--seconds N] [-o FOLDER] [--publish]`.
FOLDER gets bench.json and bench.md. With --publish a run of all rows also renews the table in
docs/performance.md. Exit status: 1 if a row failed; no figure is asserted.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from benchmarks import browse, captures, decoding, first_lines, framed, latency, live
from benchmarks.commands import ROOT, Skipped, tell
from benchmarks.report import Row, as_json, as_markdown, between_markers, cells, machine
from benchmarks.setting import FULL, QUICK, Setting, Work

_FOLDER = ROOT / "build/bench"
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
    """Measure the rows that are asked for; returns 1 if one failed, 130 if it was interrupted."""
    options = _options()
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background job ignores the first
        signal.signal(number, signal.default_int_handler)
    works = [work for work in WORKS if fnmatch(work.name, options.only)]
    sizes = QUICK if options.quick else FULL
    seconds = options.seconds or (2 if options.quick else 60)
    mode = "quick" if options.quick else "full"
    on, rows, interrupted = machine(), [], False
    with tempfile.TemporaryDirectory(prefix="bilprov-bench-") as folder:
        setting = Setting(Path(folder), sizes, seconds)
        try:
            for work in works:
                rows.append(measured(setting, work))
        except KeyboardInterrupt:
            interrupted = True
            tell("interrupted: the rows that were measured are written")
    _write(options.folder, rows, on, mode)
    if options.publish and not interrupted and len(rows) == len(WORKS):
        _publish(rows, on, mode)
    if interrupted:
        return 130
    return int(any(row.state == "failed" for row in rows))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, under a minute")
    parser.add_argument("--only", default="*", metavar="NAME", help="rows by name, * for any")
    parser.add_argument("--seconds", type=float, metavar="N", help="on the fast line (60)")
    parser.add_argument("-o", dest="folder", type=Path, default=_FOLDER, metavar="FOLDER")
    parser.add_argument("--publish", action="store_true", help="renew docs/performance.md")
    options = parser.parse_args()
    if not any(fnmatch(work.name, options.only) for work in WORKS):
        parser.error(f"no row is {options.only}: there are {', '.join(w.name for w in WORKS)}")
    return options


def measured(setting: Setting, work: Work) -> Row:
    """Measure one row and tell it; what is missing or breaks ends that row alone."""
    begun = time.monotonic()
    try:
        row = work.measure(setting, work)
    except Skipped as reason:
        row = Row(work.name, work.words, note=str(reason), state="skipped")
    except Exception as error:  # the other rows are still worth their time
        told = f"{type(error).__name__}: {error}"
        row = Row(work.name, work.words, note=told, state="failed")
    shown = "; ".join(filter(None, cells(row)[1:]))
    tell(f"{work.name:18} {shown} [{time.monotonic() - begun:.1f} s]")
    return row


def _write(folder: Path, rows: Sequence[Row], on: str, mode: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    told = json.dumps(as_json(rows, on, mode), indent=1, ensure_ascii=False)
    (folder / "bench.json").write_text(told + "\n", encoding="utf-8")
    (folder / "bench.md").write_text(as_markdown(rows, on, mode), encoding="utf-8")
    tell(f"written: bench.json and bench.md in {folder}")


def _publish(rows: Sequence[Row], on: str, mode: str) -> None:
    text = _PAGE.read_text(encoding="utf-8")
    told = between_markers(text, as_markdown(rows, on, mode, short=True))
    _PAGE.write_text(told, encoding="utf-8")
    tell(f"renewed: the table in {_PAGE}")


if __name__ == "__main__":
    sys.exit(main())
