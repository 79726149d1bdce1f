"""`bilprov send`: what it sends and shows, and that it leaves the device at rest."""

from __future__ import annotations

import json

import pytest

from tests.support.commands import process
from tests.support.robots import sentence, simulate

pytestmark = pytest.mark.waits


def test_instructions_and_bytes_are_sent_and_their_answers_shown() -> None:
    with simulate() as served:
        result = process(
            *("send", served.port, "speed 80", "LED rgb=5", "Forward", "93 00 00 00", "pause=1"),
            *("--yes", "--format", "jsonl"),
        )
        state = served.state()

    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    said = [(line["direction"], line["hex"], line["name"]) for line in lines]
    assert said == [
        ("host", "11 50", "Speed"),
        ("device", "00", "OK"),
        ("host", "81 05", "LED"),
        ("device", "00", "OK"),
        ("host", "20", "Forward"),
        ("device", "00", "OK"),
        ("host", "93 00 00 00", None),
        ("device", "01", "BAD_HEADER"),
    ]
    assert (state["moving"], state["speed"], state["led"]) == (False, 80, 5)


def test_the_robot_is_left_at_rest_although_it_was_sent_forward() -> None:
    with simulate() as served:
        result = process("send", served.port, "Speed 255", "Forward", "--together", "--yes")
        state = served.state()

    assert result.returncode == 0
    assert state["moving"] is False
    assert "Forward" in result.stdout.decode()


def test_a_frame_that_is_cut_short_is_answered_after_its_time_out() -> None:
    with simulate() as served:
        result = process("send", served.port, "41", "Stop", "--yes")

    assert result.returncode == 0
    assert "TOO_FEW_DATA" in result.stdout.decode()


def test_what_is_not_answered_ends_with_1() -> None:
    with simulate("--fault", "silent-on-faults") as served:
        result = process("send", served.port, "90", "--yes")

    assert result.returncode == 1
    assert "no answer came to 1 of 1 instruction" in result.stderr.decode()


@pytest.mark.parametrize(
    ("items", "words"),
    [
        (["Hoot"], "is not hex"),
        (["LED rgb=9"], "allowed are 0 to 7"),
        (["pause=-1"], "is no pause"),
        (["Forward"], "say --yes"),
        ([], "missing argument"),
    ],
)
def test_what_cannot_be_sent_is_said_in_one_sentence_and_nothing_is_sent(
    items: list[str], words: str
) -> None:
    with simulate() as served:
        result = process("send", served.port, *items)
        state = served.state()

    assert result.returncode == 2
    assert words in sentence(result)
    assert state["speed"] == 0
