"""Commands over captures of foreign devices: they count, filter, draw and export the frames."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from bilprov.analyzer.decode.records import shapes_of
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.replay.recorder import RecordWriter
from bilprov.analyzer.screen.figures import figures
from bilprov.analyzer.totals.totals import Totals
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC, events
from tests.analyzer.replay.test_capture_grammar import about
from tests.support.commands import command

# How many requests and answers a recording has, and how many bytes of each side.
SIZES = {"sr_wizmodbus": (44, 44, 352, 364), "optiboot44_avrdude": (28, 28, 640, 701)}


@pytest.fixture
def capture(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A recording as a capture, which names its grammar."""
    protocol = load_protocol(TRAFFIC[request.param][0])
    path = tmp_path / "line.mcap"
    with RecordWriter(path, 0, about(protocol), shapes_of(protocol)) as out:
        for chunk in events(request.param):
            out.chunk(chunk)
    return path


def printed(*words: str | Path) -> str:
    done = command(*map(str, words))
    assert (done.returncode, done.stderr.decode()) == (0, "")
    return done.stdout.decode()


@pytest.mark.parametrize("name", SIZES)
def test_totals_count_frames_answers_and_bytes(name: str) -> None:
    protocol = load_protocol(TRAFFIC[name][0])
    decoder, totals = StreamDecoder(protocol), Totals(protocol)
    for batch in [*decoder.feed(list(events(name))), *decoder.finish()]:
        totals.add(batch)
    counts = (totals.frames, totals.answers, totals.host_bytes, totals.device_bytes)
    assert counts == SIZES[name]
    assert (totals.agreeing, totals.faults.total()) == (SIZES[name][1], 0)
    shown = [line.plain for line in figures(totals, None, 86_805, 27)]
    assert shown[1] == f"{SIZES[name][0]} frames, {SIZES[name][1]} answers"


@pytest.mark.parametrize("capture", SIZES, indirect=True)
def test_statistics_and_the_plot_are_made(capture: Path, tmp_path: Path) -> None:
    (file,) = json.loads(printed("stats", capture, "--json", "-"))["files"]
    counts = file["counts"]
    assert (counts["frames"], counts["host_bytes"], counts["device_bytes"]) in {
        (frames, host, device) for frames, _, host, device in SIZES.values()
    }
    page = tmp_path / "plot.html"
    printed("plot", capture, "--html", page)
    assert "<svg" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("capture", ["sr_wizmodbus"], indirect=True)
@pytest.mark.parametrize(
    ("expression", "rows"),
    [
        ("name == WriteSingleRegister", 4),
        ("start == 1000 and quantity == 2", 2),
        ("address == 1", 88),
        ("address == 2", 0),
        ("kind == response and name == answer", 44),
        ("hex contains 44 7b", 2),
    ],
)
def test_a_filter_finds_fields_and_addresses(capture: Path, expression: str, rows: int) -> None:
    lines = printed("replay", capture, "--rate", "0", "--format", "jsonl", "--filter", expression)
    assert len(lines.splitlines()) == rows


@pytest.mark.parametrize("capture", ["sr_wizmodbus"], indirect=True)
def test_an_export_has_every_frame_and_the_values_of_its_fields(capture: Path) -> None:
    rows = list(
        csv.DictReader(io.StringIO(printed("export", capture, "--format", "csv", "-o", "-")))
    )
    lines = printed("export", capture, "--format", "jsonl", "-o", "-").splitlines()
    assert (len(rows), len(lines)) == (88, 88)
    first, answer = rows[:2]
    assert (first["name"], first["fields.start"], first["address"]) == (
        "ReadHoldingRegisters",
        "1000",
        "1",
    )
    assert answer["hex"] == "01 03 04 52 66 57 07 75 66"
    assert json.loads(lines[1])["fields"] == {"values": [21094, 22279]}
