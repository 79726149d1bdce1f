"""`bilprov stats`: what captures hold, counted; for people, and as JSON for programs."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from random import Random
from statistics import median
from typing import Any

import pytest

from bilprov.analyzer.output import capture_stats
from bilprov.analyzer.replay.capture_totals import capture_totals
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.captures.writer import CaptureWriter
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command, process
from tests.support.decoding import MS, Event, conversation

pytestmark = pytest.mark.slow  # more than make quick has time for

EXAMPLES = str(ROOT / "captures" / "samples" / "examples.mcap")


def written(path: Path, events: Sequence[Event], **metadata: str) -> str:
    metadata = {"attached": "no", "heard": "host device", **metadata}
    with CaptureWriter(path, start_wall=10**18, metadata=metadata, version="1") as writer:
        for event in events:
            if isinstance(event, Chunk):
                writer.chunk(event)
            else:
                writer.write(event, event.t)
    return str(path)


def counted(*arguments: str) -> Any:
    result = command("stats", *arguments, "--json", "-")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_the_counts_are_those_of_the_lines_that_replay_shows() -> None:
    shown = command("replay", EXAMPLES, "--rate", "0", "--format", "jsonl").stdout
    lines = [json.loads(line) for line in shown.splitlines()]
    frames = [line for line in lines if line["sequence"] is not None and line["direction"]]
    answers = [line for line in lines if line["kind"] == "response"]

    (file,) = counted(EXAMPLES)["files"]

    counts = file["counts"]
    assert counts["frames"] == len(frames) > 0
    assert counts["device_bytes"] == len(answers) > 0
    names = Counter(line["name"] for line in frames if line["name"])
    assert {n: c for n, c in counts["instructions"].items() if c and "unused" not in n} == names
    expected = Counter(line["judgement"] for line in frames)
    assert {name: count for name, count in counts["expected"].items() if count} == expected
    given = Counter(line["name"] for line in answers)
    assert {name: count for name, count in counts["responses"].items() if count} == given
    assert counts["agreeing"] == sum(line["agrees"] is True for line in answers)
    assert counts["anomalies"] == Counter(kind for line in lines for kind in line["faults"])
    for side in ("host", "device"):
        odd = (kind for line in lines if line["direction"] == side for kind in line["faults"])
        assert counts["by_direction"][side] == Counter(odd)
    said = {line["sequence"]: line["name"] for line in frames}
    for name, one in counts["by_instruction"].items():
        if "unused" not in name:
            mine = [line for line in answers if said[line["answers"]] == name]
            assert one["frames"] == counts["instructions"][name]
            assert one["responses"] == Counter(line["name"] for line in mine)
            ends = {line["latency"] for line in mine}
            if ends:
                assert (one["latency"]["min"], one["latency"]["max"]) == (min(ends), max(ends))
    bins = counts["latency_bins"]
    assert sum(one["count"] for one in bins) == len(answers)
    rates = file["rates"]
    assert sum(rates["frames"]) == len(frames)
    assert rates["step"] == 1
    latencies = sorted(line["latency"] for line in answers)
    assert (counts["latency"]["min"], counts["latency"]["max"]) == (latencies[0], latencies[-1])
    assert counts["latency"]["median"] == pytest.approx(median(latencies), abs=1e-6)


def test_load_percentiles_and_time_moving_are_those_worked_out_by_hand(tmp_path: Path) -> None:
    # 200 instructions of two bytes, 30 ms apart, at 9600 bit/s with 10 bits a byte.
    latencies = [1] * 197 + [5, 5, 9]  # ms
    events: list[Event] = []
    for place, latency in enumerate(latencies):
        sent = b"\x11\x7f" if place else b"\x20"  # the first one is Forward
        events += [
            Chunk(30 * place * MS, "host", sent),
            Chunk((30 * place + latency) * MS, "device", b"\0"),
        ]
    long = written(tmp_path / "long.mcap", events, line="9600 8N1")
    short = written(tmp_path / "short.mcap", events[:40], line="9600 8N1")

    found = counted(long, short)

    first, second = (file["counts"] for file in found["files"])
    assert (first["duration"], second["duration"]) == (pytest.approx(5.979), pytest.approx(0.571))
    assert first["moving"] == pytest.approx(5.949)  # from the first Speed to the last answer
    assert first["load"] == {
        "host": pytest.approx(399 / 960 / 5.979),
        "device": pytest.approx(200 / 960 / 5.979),
    }
    together = found["total"]
    assert together["moving"] == pytest.approx(5.949 + 0.541)
    assert together["load"] == {
        "host": pytest.approx((399 + 39) / 960 / 6.55),
        "device": pytest.approx((200 + 20) / 960 / 6.55),
    }
    spread = {"min": 0.001, "median": 0.001, "p95": 0.001, "p99": 0.005, "max": 0.009}
    assert first["latency"] == {"count": 200, **spread}
    assert (first["peak"], together["peak"]) == (34, 34)
    assert found["files"][0]["rates"]["frames"] == [34, 33, 33, 34, 33, 33]
    shown = " ".join(command("stats", long).stdout.decode().split())
    assert "load: host 7 %, device 3.5 %" in shown
    assert re.search(r"frames \S+ 33.45 34 ", shown)  # the mean is by the duration


def test_every_key_is_explained() -> None:
    found = counted(EXAMPLES)
    file, total = found["files"][0], found["total"]
    keys = {*found, *file, *total, *file["rates"], *found["grammar"]}
    keys |= {*total["latency"], *total["load"], *total["latency_bins"][0]}
    keys |= {*total["by_direction"], *next(iter(total["by_instruction"].values()))}

    explained = set(re.findall(r"`(\w+)`", capture_stats.__doc__ or ""))

    assert keys <= explained


def test_several_captures_are_counted_one_by_one_and_together(tmp_path: Path) -> None:
    other = written(tmp_path / "other.mcap", conversation([(b"\x20", b"\0")] * 3))

    found = counted(EXAMPLES, other, EXAMPLES)

    assert [file["path"] for file in found["files"]] == [EXAMPLES, other, EXAMPLES]
    each = [file["counts"] for file in found["files"]]
    total = found["total"]
    for key in ("frames", "host_bytes", "device_bytes", "agreeing", "disagreeing", "truncated"):
        assert total[key] == sum(counts[key] for counts in each)
    for key in ("instructions", "expected", "responses", "anomalies"):
        together = sum((Counter(counts[key]) for counts in each), Counter())
        assert +Counter(total[key]) == together
    assert total["duration"] == pytest.approx(sum(counts["duration"] for counts in each))
    assert total["latency"]["max"] == max(counts["latency"]["max"] for counts in each)


def test_the_settings_of_the_recording_are_used(tmp_path: Path, protocol: Protocol) -> None:
    events: list[Event] = [Chunk(0, "host", b"\x11"), Chunk(30 * MS, "host", b"\x05")]

    kinds = [
        capture_totals(
            open_capture(written(tmp_path / f"{ms}.mcap", events, truncation_timeout_ms=ms)),
            protocol,
        ).kinds
        for ms in ("20", "40")
    ]

    assert kinds == [{"truncated": 2}, {"instruction": 1}]


def test_progress_is_told_all_bytes_in_batches(tmp_path: Path, protocol: Protocol) -> None:
    stops, answers = bytes([protocol.pad_byte]) * 4096, bytes(4096)
    events: list[Event] = []
    for number in range(200):
        events += [Chunk(number * MS, "host", stops), Chunk(number * MS, "device", answers)]
    events.insert(7, Line(3 * MS, "break"))
    told: list[int] = []

    totals = capture_totals(
        open_capture(written(tmp_path / "c.mcap", events)), protocol, told.append
    )

    assert sum(told) == 2 * totals.host_bytes == 400 * 4096
    assert max(told) <= 1 << 20  # so that memory stays flat
    assert len(told) > 1


def rows_of(*arguments: str) -> list[dict[str, str]]:
    text = command("stats", *arguments, "--csv", "-").stdout.decode()
    return list(csv.DictReader(io.StringIO(text, newline="")))


def test_the_csv_has_every_number_of_the_json(tmp_path: Path) -> None:
    other = written(tmp_path / "other.mcap", conversation([(b"\x20", b"\0"), (b"\x90", b"\0")]))
    found = counted(EXAMPLES, other)

    rows = rows_of(EXAMPLES, other)

    def values(file: str, group: str) -> dict[tuple[str, str], float]:
        mine = [row for row in rows if (row["file"], row["group"]) == (file, group)]
        numbers = {(row["key"], row["measure"]): float(row["value"]) for row in mine}
        assert len(numbers) == len(mine)
        return numbers

    parts = [(file["path"], file["counts"]) for file in found["files"]] + [("", found["total"])]
    for path, counts in parts:
        total = {("", key): v for key, v in counts.items() if isinstance(v, int | float)}
        total |= {("", f"load.{side}"): share for side, share in counts["load"].items()}
        assert values(path, "total") == total
        one = counts["by_instruction"]
        assert values(path, "instruction") == {(n, "frames"): c["frames"] for n, c in one.items()}
        assert values(path, "answer") == {
            (name, response): count
            for name, c in one.items()
            for response, count in c["responses"].items()
        }
        assert values(path, "instruction anomaly") == {
            (name, kind): count for name, c in one.items() for kind, count in c["anomalies"].items()
        }
        latencies = {"": counts["latency"]} | {name: c["latency"] for name, c in one.items()}
        assert values(path, "latency") == {
            (name, key): v
            for name, spread in latencies.items()
            for key, v in (spread or {}).items()
        }
        assert values(path, "anomaly") == {
            (kind, side): count
            for side, kinds in counts["by_direction"].items()
            for kind, count in kinds.items()
        }
        given = values(path, "response")
        assert {name: n for (name, key), n in given.items() if key == "given"} == counts[
            "responses"
        ]
        assert sum(values(path, "latency bin").values()) == counts["latency"]["count"]
    for file in found["files"]:
        rates = values(file["path"], "rate")
        assert sum(n for (_, key), n in rates.items() if key == "frames") == sum(
            file["rates"]["frames"]
        )


def test_a_name_in_the_csv_is_no_formula_and_controls_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "=cmd|'x'\x1b[31m"
    folder.mkdir()
    written(folder / "=1+1.mcap", [])

    result = command("stats", "=1+1.mcap", "--csv", "-", cwd=folder)
    absolute = command("stats", str(folder / "=1+1.mcap"), "--csv", "-")

    assert b"\r\n'=1+1.mcap,total,,frames,0\r\n" in result.stdout
    assert b"\x1b" not in absolute.stdout + command("stats", str(folder / "=1+1.mcap")).stdout


def test_only_what_passes_the_filter_is_counted() -> None:
    shown = command(
        "replay", EXAMPLES, "--rate", "0", "--format", "jsonl", "--filter", "faulty"
    ).stdout
    lines = [json.loads(line) for line in shown.splitlines()]

    found = counted(EXAMPLES, "--filter", "faulty")

    assert found["filter"] == "faulty"
    assert found["total"]["frames"] == len([x for x in lines if x["direction"] == "host"]) > 0
    assert found["total"]["anomalies"] == Counter(kind for x in lines for kind in x["faults"])
    shown = command("stats", EXAMPLES, "--filter", "faulty").stdout
    assert b"Only what passes faulty is counted." in shown


def busy(protocol: Protocol, seconds: int) -> list[Event]:
    """A recording with every instruction, answers of many latencies, and a line that is full."""
    random, events = Random(1), []
    for second in range(seconds):
        for _ in range(random.randrange(20)):
            header = random.randrange(256)
            frame = bytes([header]) + random.randbytes(protocol.lengths[header])
            t = second * 1000 * MS + random.randrange(900) * MS
            events.append(Chunk(t, "host", frame))
            events.append(Chunk(t + random.randrange(90 * MS), "device", random.randbytes(1)))
    return sorted(events, key=lambda event: event.t)


@pytest.mark.parametrize(("encoding", "block"), [("utf-8", "█"), ("ascii", "#")])
def test_the_tables_fit_80_columns_in_any_encoding(
    tmp_path: Path, protocol: Protocol, encoding: str, block: str
) -> None:
    file = written(tmp_path / "c.mcap", busy(protocol, 90))

    result = process("stats", file, cwd=tmp_path, env={"PYTHONIOENCODING": encoding})

    shown = result.stdout.decode(encoding)
    lines = shown.replace(str(tmp_path), "").splitlines()
    assert (result.returncode, result.stderr) == (0, b"")
    assert block * 10 in shown
    assert max(map(len, lines)) <= 80
    assert all(line.isprintable() for line in lines)


@pytest.mark.waits
def test_ctrl_c_ends_it_without_a_word_and_leaves_no_json(
    tmp_path: Path, grammar_text: str
) -> None:
    grammar, file = tmp_path / "interrupting.py", tmp_path / "stats.json"
    interrupt = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    grammar.write_text(grammar_text + interrupt, encoding="utf-8")

    result = process("--grammar", str(grammar), "stats", EXAMPLES, "--json", str(file))

    assert (result.returncode, result.stdout, result.stderr) == (130, b"", b"")
    assert not file.exists()
