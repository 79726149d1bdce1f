"""`bilprov export`: the rows that replay shows in each format, whole files or none, flat memory."""

from __future__ import annotations

import csv
import io
import json
import signal
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from bilprov.analyzer.cli.stats import CHOICES, FORMATS
from bilprov.analyzer.export.rows import Chosen
from bilprov.analyzer.output.outputs import Window
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.commands import command, process, running
from tests.support.csv_cells import plain
from tests.support.decoding import Event, conversation
from tests.support.grammars import undeclared
from tests.support.robots import until
from tests.support.terminals import on_terminal

pytestmark = pytest.mark.usefixtures("columns_at_once")

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
START = 1_790_000_000_123_456_789
TALK = [(b"\x11\x7f", b"\0"), (b"\x20", b"\0"), (b"\x81\x05", b"\0"), (b"\x90", b"\1")]


def written(
    path: Path, events: Iterable[Event], chosen: dict[str, Any] | None = None, start: int = START
) -> Path:
    """A capture of events, with the settings of a Session."""
    chosen = chosen or {}
    timeout = chosen.get("timeout") or 50 * MS
    metadata = {
        "attached": "yes" if chosen.get("attached") else "no",
        "heard": " ".join(sorted(chosen.get("heard", ("host", "device")))),
        "skew_ms": str(chosen.get("skew", 0) / MS),
        "truncation_timeout_ms": str(timeout / MS),
    }
    return write_capture(path, events, metadata, start)


def exported(path: Path, style: str, *more: str) -> bytes:
    done = command("export", str(path), "--format", style, "-o", "-", *more)
    assert (done.returncode, done.stderr) == (0, b"")
    return done.stdout


def written_by(writer: Callable[..., None], capture: Capture, protocol: Protocol) -> bytes:
    stream = io.BytesIO()
    writer(Chosen(capture, protocol, None, Window(), lambda size: None), stream)
    return stream.getvalue()


def parquet_rows(data: bytes) -> list[dict[str, Any]]:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pip install 'bilprov[parquet]'")
    table = parquet.read_table(io.BytesIO(data))
    if "time" in table.column_names:  # Python has no nanoseconds
        place = table.column_names.index("time")
        assert str(table.schema.field(place).type) == "timestamp[ns, tz=UTC]"
        table = table.set_column(place, "time", table["time"].cast("int64"))
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def flat(line: dict[str, Any]) -> dict[str, Any]:
    """The values of a JSON line that are not null or empty, under the names of a table."""
    row = dict(line)
    for name in ("fields", "state"):
        row |= {f"{name}.{key}": value for key, value in row.pop(name).items()}
    return {key: value for key, value in row.items() if value not in (None, "", [])}


def csv_rows(data: bytes) -> list[dict[str, Any]]:
    """The rows of a CSV file as `flat` has them."""
    texts = {"direction", "kind", "hex", "name", "judgement", "reason", "state.motion"}

    def value(name: str, cell: str) -> Any:
        if name == "faults":
            return plain(cell).split("; ")
        return plain(cell) if name in texts else json.loads(cell)

    reader = csv.DictReader(io.StringIO(data.decode(), newline=""))
    return [{name: value(name, cell) for name, cell in row.items() if cell} for row in reader]


def test_parquet_has_types_and_the_columns_that_are_asked_for(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", conversation(TALK))
    asked = "t,T_ns,time,name,bytes,latency,latency_ns,speed,state.moving,faults"
    first, answer, *_ = parquet_rows(exported(path, "parquet", "--columns", asked))

    assert list(first) == [name.lower() for name in asked.split(",")]
    assert (first["t"], first["t_ns"], first["bytes"]) == (0.02, 20 * MS, b"\x11\x7f")
    assert first["time"] == START + 20 * MS
    assert (first["speed"], first["state.moving"], first["faults"]) == (127, False, [])
    assert (answer["latency"], answer["latency_ns"]) == (0.001, MS)


def test_numbers_that_64_bits_cannot_hold_are_decimals(tmp_path: Path, grammar_text: str) -> None:
    short, field = "BitStruct, Byte,", '"speed" / Ranged(Byte, 0, 255)'
    long = '"speed" / Ranged(BytesInteger(15), 0, 2**120 - 1)'
    grammar = tmp_path / "long.py"
    text = undeclared(grammar_text).replace(short, f"{short} BytesInteger,")
    grammar.write_text(text.replace(field, long))
    said = b"\x1f" + b"\xff" * 15
    path = written(tmp_path / "a.mcap", conversation([(said, b"\0")]))

    row, _ = parquet_rows(exported(path, "parquet", "--grammar", str(grammar)))

    assert row["fields.speed"] == row["state.speed"] == 2**120 - 1


@pytest.mark.parametrize("start", [2**63, 2**63 - 50 * MS])
def test_a_time_that_parquet_cannot_hold_is_one_sentence(tmp_path: Path, start: int) -> None:
    path = written(tmp_path / "a.mcap", conversation(TALK), start=start)
    done = command("export", str(path), "--format", "parquet", "-o", str(tmp_path / "a.parquet"))

    assert done.returncode == 2
    assert b"out of the range of Parquet (1677 to 2262): export it as csv" in done.stderr
    assert done.stderr.count(b"\n") == 1
    assert list(tmp_path.iterdir()) == [path]
    assert csv_rows(exported(path, "csv"))


def test_without_pyarrow_the_line_that_brings_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    out = tmp_path / "a.parquet"

    done = command("export", str(SAMPLE), "--format", "parquet", "-o", str(out))

    assert done.returncode == 2
    assert done.stderr == (
        b"bilprov: parquet needs pyarrow, which is not installed: pip install 'bilprov[parquet]'\n"
    )
    assert not list(tmp_path.iterdir())


def much(path: Path, kilobytes: int) -> Path:
    """A capture with so much of the host in regular traffic, and its answers."""
    random, events = Random(1), list[Chunk | Line]()
    for at in range(kilobytes * 1_000 // 6000):
        said = bytearray(b"\x11" * 6000)
        said[1::2] = random.randbytes(3000)  # so that the file is not packed to nothing
        events.append(Chunk(at * 2 * MS, "host", bytes(said)))
        events.append(Chunk(at * 2 * MS + MS, "device", bytes(3000)))
    return written(path, events)


PEAK = """
import resource, sys
from bilprov.__main__ import main
try:
    main(["export", *sys.argv[1:]])
finally:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, file=sys.stderr)
"""


@pytest.mark.sample(0)
@pytest.mark.waits
@pytest.mark.parametrize("style", FORMATS)
def test_memory_does_not_grow_with_the_capture(tmp_path: Path, style: str) -> None:
    columns = ["--columns", "t,name"] if style in CHOICES["columns"] else []
    peaks = []
    for size in (250, 500):
        path = much(tmp_path / f"{size}.mcap", size)
        done = process(
            str(path), "--format", style, "-o", str(tmp_path / f"{size}.out"), *columns, code=PEAK
        )
        assert done.returncode == 0, done.stderr
        peaks.append(int(done.stderr))

    more = (tmp_path / "500.out").stat().st_size - (tmp_path / "250.out").stat().st_size
    assert style == "parquet" or more > 3_000_000
    assert peaks[1] - peaks[0] < 15


@pytest.mark.waits
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_export_leaves_no_file(tmp_path: Path, number: signal.Signals) -> None:
    path, out = much(tmp_path / "a.mcap", 1500), tmp_path / "a.csv"
    with running("export", str(path), "--format", "csv", "-o", str(out)) as export:
        until(lambda: any(p.stat().st_size > 100_000 for p in tmp_path.glob(".a.csv.*")))
        code, _, said = export.end(number)

    assert (code, said.decode()) == (130, "stopped before the end\n")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.sample(1)
@pytest.mark.waits
@pytest.mark.parametrize(
    ("kilobytes", "more", "words", "code"),
    [
        (700, ["--format", "csv", "-o", "a.csv"], "100%", 0),
        (0, ["--format", "parquet", "-o", "-"], "is a terminal", 2),
    ],
)
def test_on_a_terminal_progress_is_drawn_and_nothing_but_text_written(
    tmp_path: Path, kilobytes: int, more: list[str], words: str, code: int
) -> None:
    path = much(tmp_path / "a.mcap", kilobytes) if kilobytes else SAMPLE
    more = [str(tmp_path / one) if one == "a.csv" else one for one in more]
    with on_terminal("export", str(path), *more) as terminal:
        terminal.wait_for(words)
        assert terminal.end() == code
