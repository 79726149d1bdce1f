"""`bilprov replay`: a capture is shown again, or sent to a device again."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from benchmarks.adapter import Adapter
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.replay.comparison import (
    UNANSWERED_STOPS,
    Exchanges,
    differences,
    first_difference,
)
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import PLAIN_ANSWER, Protocol, load
from bilprov.spec.replies import build_reply
from tests.support import commands
from tests.support.captures import write_capture
from tests.support.commands import running
from tests.support.decoding import MS, Event, conversation
from tests.support.framed_traffic import FRAMED
from tests.support.robots import RecordingRobot, served_here, until
from tests.support.wires import json_lines

pytestmark = pytest.mark.waits

TALK = [
    (b"\x11\x7f", b"\0"),
    (b"\x20", b"\0"),
    (b"\x81\x05", b"\0"),
    (b"\x90", b"\1"),
    (b"\x00", b"\0"),
]
START = 1_700_000_000_000_000_000

Write = Callable[..., Path]


@pytest.fixture
def capture(tmp_path: Path) -> Write:
    def write(events: Iterable[Event], metadata: dict[str, str] | None = None) -> Path:
        return write_capture(tmp_path / "given.mcap", events, metadata, START)

    return write


def test_a_frame_decided_by_silence_is_shown_while_a_slow_replay_waits_and_ctrl_c_ends_it(
    capture: Write,
) -> None:
    path = capture([Chunk(0, "host", b"\x11"), Chunk(3600_000 * MS, "host", b"\x00")])

    with running("replay", str(path), "--format", "jsonl") as command:
        assert json_lines(command.stdout.readline())[0]["kind"] == "truncated"
        code, _, err = command.end()

    assert (code, err) == (0, b"")


def test_a_recording_that_is_not_judged_to_its_end_conforms_no_more_than_it_was_judged(
    capture: Write,
) -> None:
    path = capture(
        [
            Chunk(0, "host", b"\x20"),
            Chunk(MS, "device", b"\0"),
            Chunk(3600_000 * MS, "host", b"\0"),
        ]
    )
    with running("replay", str(path), "--judge", "--format", "jsonl") as command:
        assert [json_lines(command.stdout.readline())[0]["kind"] for _ in range(2)]
        code, out, _ = command.end()
    findings = json_lines(out)[-1]
    assert (code, findings["exit"], findings["stopped"], findings["judged"]) == (3, 3, True, 1)


@pytest.mark.parametrize("rate", ["0", "1"])
def test_a_device_that_answers_as_recorded_is_fine(
    capture: Write, protocol: Protocol, rate: str
) -> None:
    robot = RecordingRobot(protocol)
    path = capture(conversation(TALK))

    with served_here(robot, pty=True) as (port, _):
        run = commands.command("replay", str(path), "--rate", rate, "--to", port, "--yes")

    assert run.returncode == 0, run.stderr
    homing = [bytes([protocol.pad_byte])] * protocol.longest_frame
    assert robot.heard == [*homing, *(said for said, _ in TALK), *homing]


def test_a_device_that_is_lost_in_the_last_homing_is_no_success(
    capture: Write, tmp_path: Path, protocol: Protocol
) -> None:
    path, port = capture(conversation(TALK)), tmp_path / "port"
    before = protocol.longest_frame + sum(len(said) for said, _ in TALK)

    with (
        served_here(RecordingRobot(protocol), pty=True) as (line, _),
        Adapter(port, line, [before + 1], None),
    ):
        run = commands.command("replay", str(path), "--rate", "0", "--to", str(port), "--yes")

    assert run.returncode == 1, run.stderr
    assert UNANSWERED_STOPS.encode() in run.stderr


def test_a_frame_cut_short_is_sent_cut_short(capture: Write, protocol: Protocol) -> None:
    robot = RecordingRobot(protocol)
    events = [
        Chunk(0, "host", b"\x11"),
        Chunk(51 * MS, "device", b"\x04"),
        Chunk(100 * MS, "host", b"\x20"),
        Chunk(101 * MS, "device", b"\x00"),
    ]

    with served_here(robot, pty=True) as (port, _):
        run = commands.command("replay", str(capture(events)), "--rate", "0", "--to", port, "--yes")

    assert run.returncode == 0, run.stdout
    assert robot.heard[16:-16] == [b"\x11", b"\x20"]


def test_ctrl_c_leaves_the_device_stopped(capture: Write, protocol: Protocol) -> None:
    robot = RecordingRobot(protocol)
    path = capture([Chunk(0, "host", b"\x11\xff\x20"), Chunk(3600_000 * MS, "host", b"\x00")])

    with (
        served_here(robot, pty=True) as (port, _),
        running("replay", str(path), "--to", port, "--yes", "--format", "jsonl") as command,
    ):
        until(lambda: b"\x20" in robot.heard)
        code, _, _ = command.end()

    assert code == 0
    assert robot.heard[-16:] == [bytes([protocol.pad_byte])] * 16


def test_ctrl_c_ends_what_is_sent_as_fast_as_it_is_answered(
    capture: Write, protocol: Protocol
) -> None:
    """All of it came at once; each frame waits for an answer that never comes."""
    robot = RecordingRobot(protocol, wrong={b"\x20": None})
    path = capture([Chunk(0, "host", b"\x11\xff" + b"\x20" * 300)])  # few enough for a pipe

    with (
        served_here(robot, pty=True) as (port, _),
        running("replay", str(path), "--rate", "0", "--to", port, "--yes") as command,
    ):
        until(lambda: robot.heard.count(b"\x20") >= 2)
        code, _, _ = command.end()

    assert code in (0, 1)  # 1: nobody answers the stops
    assert 2 <= robot.heard.count(b"\x20") < 100


class Flooding(RecordingRobot):
    """A device that sends without end."""

    def advance(self, now: int) -> bytes:
        return super().advance(now) + bytes(100)

    def deadline(self) -> int:
        return 0


def test_a_device_that_floods_the_line_is_stopped_at_once(
    capture: Write, protocol: Protocol
) -> None:
    robot = Flooding(protocol)
    path = capture([Chunk(0, "host", b"\x20"), Chunk(3600_000 * MS, "host", b"\x00")])

    with (
        served_here(robot, pty=True) as (port, _),
        running("replay", str(path), "--to", port, "--yes") as command,
    ):
        code, _, err = command.result()

    assert code == 1
    assert err.startswith(b"the device floods the line, which it did not in the recording")
    assert robot.heard[-16:] == [bytes([protocol.pad_byte])] * 16


def test_without_a_terminal_a_device_moves_only_with_yes(
    capture: Write, protocol: Protocol
) -> None:
    robot = RecordingRobot(protocol)

    with served_here(robot, pty=True) as (port, _):
        run = commands.command("replay", str(capture(conversation(TALK))), "--to", port)

    assert run.returncode == 2
    assert b"--yes" in run.stderr
    assert robot.heard == []


def run_of(protocol: Protocol, asked: bytes, answered: bytes) -> Exchanges:
    run, session = Exchanges(), Session(protocol)
    for event in (Chunk(0, "host", asked), Chunk(MS, "device", answered)):
        for record in session.feed(event):
            run.record(record)
    for record in session.finish():
        run.record(record)
    return run


def test_a_damaged_answer_differs_from_a_right_one_without_a_code() -> None:
    protocol = load(FRAMED["roboclaw"])
    asked = build(protocol, "MainBattery", {"address": 0x80})
    right = build_reply(protocol, judge(protocol, asked), {"voltage": 120})
    damaged = right[:-1] + bytes([right[-1] ^ 1])
    recorded, now = (run_of(protocol, asked, answer) for answer in (right, damaged))

    (difference,) = differences(protocol, recorded, now)

    assert difference.reason.endswith("now a damaged answer")
    assert first_difference(protocol, now, [PLAIN_ANSWER.code])
    assert not first_difference(protocol, recorded, [PLAIN_ANSWER.code])


def test_bytes_that_answer_nothing_are_all_counted_and_a_few_are_listed(protocol: Protocol) -> None:
    recorded, now = (run_of(protocol, b"\x00", b"\x00" * answers) for answers in (1, 5000))

    (difference,) = differences(protocol, recorded, now)
    assert difference.reason.startswith("bytes that answer no instruction: recorded 0, now 4999 (")
    assert len(difference.reason) < 200
    assert now.floods(recorded)
    assert not now.floods(now)  # a device that was as talkative when it was recorded
