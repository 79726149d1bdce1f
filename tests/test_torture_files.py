"""The harms to capture files: small runs hold, a seed draws the same again, planted faults show."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from benchmarks.torture import chunks, damage, hostile, kills
from benchmarks.torture.harm import Harm, Measured, measured
from bilprov.captures.reader import Capture, Message
from bilprov.captures.schemas import Chunk
from bilprov.captures.storage import survey
from bilprov.captures.storage.recovery import RecordFile
from bilprov.captures.writer import CaptureWriter


def done(harm: Harm, runs: int) -> Measured:
    return measured(harm, runs, seed=1)


def wrong(result: Measured) -> list[str]:
    return [sentence for row in result.rows for sentence in row.wrong]


@pytest.mark.slow
@pytest.mark.parametrize("harm", [damage.HARM, chunks.HARM], ids=lambda harm: harm.name)
def test_damaged_captures_hold_and_a_seed_damages_them_alike(harm: Harm) -> None:
    result = done(harm, 48)

    assert wrong(result) == []
    assert sum(row.times for row in result.rows) == 48
    assert done(harm, 48).rows == result.rows


def test_every_damage_changes_what_it_is_given() -> None:
    draw = Random(1)
    for change in (*damage.DAMAGES.values(), *chunks.CHANGES.values()):
        for data in (chunks.recorded(), *(kind.files[0] for kind in damage.kinds())):
            assert any(change(draw, data) != data for _ in range(20))


@pytest.mark.slow
def test_a_reader_that_tells_no_damage_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey._Survey, "_note", lambda self, sentence: None)

    assert any("which nothing tells" in sentence for sentence in wrong(done(damage.HARM, 48)))


@pytest.mark.slow
def test_a_reader_that_changes_a_message_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    damage.kinds()  # recorded before the fault is there
    for kind in damage.kinds():
        damage.recorded(kind)
    chunks.held()
    read = Capture.messages

    def late(capture: Capture) -> Iterator[Message]:
        for message in read(capture):
            yield Message(message.topic, message.t + 1, message.value, message.sequence)

    monkeypatch.setattr(Capture, "messages", late)

    assert any("not recorded" in sentence for sentence in wrong(done(damage.HARM, 48)))
    assert any("not recorded" in sentence for sentence in wrong(done(chunks.HARM, 9)))


@pytest.mark.slow
def test_a_reader_that_ends_at_the_first_damage_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    chunks.held()
    monkeypatch.setattr(RecordFile, "next_chunk", lambda file, offset, until=None: None)

    assert any("is kept" in sentence for sentence in wrong(done(chunks.HARM, 60)))


# -- hostile files --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize("kind", hostile.KINDS)
def test_a_hostile_file_is_read_or_refused_in_bounds(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hostile, "KINDS", {kind: hostile.KINDS[kind]})
    result = done(hostile.HARM, 1)

    assert wrong(result) == []
    assert [row.times for row in result.rows] == [1] * len(hostile.COMMANDS)


@pytest.mark.slow
def test_too_much_memory_and_a_crash_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    crash = [sys.executable, "-c", "raise ValueError('no sentence')"]
    assert "no sentence" in hostile.used(crash).wrong
    assert hostile.used([sys.executable, "-c", ""]).wrong == ""

    monkeypatch.setattr(hostile, "MOST_MEMORY", 1_000_000)
    assert "MB" in hostile.used([sys.executable, "-c", ""]).wrong


# -- kills ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.waits
def test_a_recording_that_is_killed_has_what_it_was_given() -> None:
    result = done(kills.HARM, 3)

    assert [row.times for row in result.rows] == [1, 1, 1]
    # How long the last write took is the machine's; all else must hold on a busy one too.
    assert [one for one in wrong(result) if "are lost, the feeder was" not in one] == []


FED = kills.Fed(bytes(range(100)), [(n / 100, n + 1) for n in range(100)], late=0.0)


@pytest.mark.parametrize(
    ("kept", "told"),
    [
        (FED.data, ""),
        (FED.data[:95], ""),
        (FED.data[:50], "0.500 s are lost, the feeder was 0 ms late"),
        (FED.data[:20] + FED.data[19:], "a byte is wrong or there twice"),
        (FED.data[:20] + b"\xff" + FED.data[21:], "a byte is wrong or there twice"),
    ],
)
def test_what_a_kill_may_not_cost_is_seen(tmp_path: Path, kept: bytes, told: str) -> None:
    path = tmp_path / "killed.mcap"
    with CaptureWriter(path, start_wall=0, metadata={}, version="0") as out:
        out.chunk(Chunk(0, "host", kept))

    assert kills.judged(path, FED, end=1.0).wrong == told


def test_a_capture_that_a_kill_made_unreadable_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    path.write_bytes(b"no capture")

    assert kills.judged(path, FED, end=1.0).wrong.startswith("unreadable: ")
    assert kills.judged(path, FED, end=1.0).lost == 1.0
