"""The harms to runs of the suite and to outputs: each does what it is named after, and is seen."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from random import Random

import pytest

from benchmarks.torture import nonblocking, pauses, probes, seams
from benchmarks.torture.exits import is_suspended
from benchmarks.torture.jitter import Delayed, Relay
from benchmarks.torture.robots import (
    GOOD,
    Hurt,
    Judged,
    Probe,
    Robot,
    judged,
    served,
    verdicts,
)
from bilprov.analyzer.transport.streams import parse_address

PATIENCE = 20.0  # s

# -- verdicts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("good", "code", "wrong"),
    [
        (True, 0, ""),
        (True, 1, "the reference: exit 1: fail a/case"),
        (True, 3, ""),
        (False, 0, "the reference: exit 0: fail a/case"),
        (False, 1, ""),
        (False, 3, ""),
        (False, None, "the reference: it did not end"),
    ],
)
def test_a_good_robot_that_fails_and_a_faulty_one_that_passes_are_wrong(
    good: bool, code: int | None, wrong: str
) -> None:
    found = Judged(Robot(good), code, "said\nfail a/case").wrong

    assert found.startswith(wrong)
    assert bool(found) == bool(wrong)


def test_a_robot_left_moving_and_a_traceback_are_wrong() -> None:
    assert "left moving" in Judged(GOOD[0], 0, left_moving=True).wrong
    assert "a traceback" in Judged(GOOD[0], 3, "Traceback (most recent").wrong


def test_the_row_counts_good_ones_that_failed_and_faulty_ones_that_passed() -> None:
    told = verdicts([(True, 1), (True, 0), (False, 0), (False, 1), (False, 1), (True, None)])

    assert told.startswith("1 good robots failed, 1 faulty ones passed (good: ")
    assert "exit 1 in 2" in told


@pytest.mark.sample(0)
@pytest.mark.waits
@pytest.mark.slow
def test_a_faulty_robot_that_passes_is_seen() -> None:
    passed = judged(Robot(good=False), Hurt(), 1)

    # On a busy machine something may be inconclusive.
    assert passed.code == 3 or "the reference: exit 0" in passed.wrong


# -- jitter ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("longest", [0.0, 0.01, 0.05])
def test_bytes_that_are_held_up_keep_their_order_and_come_in_time(longest: float) -> None:
    draw, held = Random(1), Delayed(longest, Random(2))
    data, came, due = draw.randbytes(300), bytearray(), list[float]()
    now = 0.0
    for start in range(0, len(data), 3):
        held.put(data[start : start + 3], now)
        due += [now + longest] * 3
        now += draw.uniform(0.0, 0.02)
        came += held.take(now)
        assert data.startswith(came)
        assert len(came) >= sum(moment <= now for moment in due)
    while held.until is not None:
        assert held.until <= due[-1]
        came += held.take(held.until)

    assert came == data


@pytest.mark.waits
def test_a_relay_hands_all_bytes_on_both_ways_also_those_on_their_way_at_its_end() -> None:
    data = Random(1).randbytes(400)
    heard = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as robot:

        def echo() -> None:
            line, _ = robot.accept()
            with line:
                while said := line.recv(100):
                    line.sendall(said[: len(data) - len(heard)])
                    heard.extend(said)

        echoing = threading.Thread(target=echo)
        echoing.start()
        with Relay(f"socket://127.0.0.1:{robot.getsockname()[1]}", 0.01, 0.01, Random(1)) as relay:
            address = parse_address(relay.name.removeprefix("socket://"))
            with socket.create_connection(address, PATIENCE) as host:
                host.sendall(data)
                answered = bytearray()
                while len(answered) < len(data):
                    answered += host.recv(100)
                host.sendall(b"stop")
        echoing.join(PATIENCE)

    assert answered == data
    assert heard == data + b"stop"


# -- probes that lie ------------------------------------------------------------------------------

TRUE: list[probes.Look] = [{"moving": number % 3 == 0, "led": number} for number in range(1000)]


def told(what: str) -> list[list[bytes]]:
    """What a probe that lies in this way tells of each true look."""
    tell = probes.LIES[what].drawn(Random(1))
    return [tell(TRUE[: number + 1]).splitlines(keepends=True) for number in range(len(TRUE))]


def is_wrong(number: int, lines: list[bytes]) -> bool:
    return lines != [probes.line(TRUE[number])]


def test_a_probe_that_forgets_knows_until_a_look_in_mid_run_and_never_after() -> None:
    lines = told("that does not know from a look in mid-run on")

    last = next(number for number, said in enumerate(lines) if is_wrong(number, said))
    assert 60 <= last <= 700
    assert lines[last:] == [[b'{"moving": null}\n']] * (len(TRUE) - last)


def test_a_probe_that_stutters_says_a_tenth_of_the_true_looks_twice() -> None:
    lines = told("that says 10 % of its looks twice")

    assert all(set(said) == {probes.line(TRUE[n])} for n, said in enumerate(lines))
    assert 70 < sum(len(said) == 2 for said in lines) < 130


@pytest.mark.parametrize(("what", "share"), [("1 %", 10), ("20 %", 200)])
def test_a_probe_that_flips_is_wrong_in_its_share_of_looks(what: str, share: int) -> None:
    lines = told(f"that is wrong in {what} of its looks")

    flipped = [number for number, said in enumerate(lines) if is_wrong(number, said)]
    assert share / 2 < len(flipped) < share * 1.5
    for number in flipped:
        true = TRUE[number]
        assert lines[number] == [probes.line({**true, "moving": not true["moving"]})]


def test_a_probe_that_mixes_says_each_of_the_last_three_looks() -> None:
    lines = told("that says its last three looks in any order")

    ages = {TRUE.index(look) - number for number, look in enumerate(map(_read, lines[2:]), 2)}
    assert ages == {-2, -1, 0}


def test_a_probe_can_always_say_the_look_before() -> None:
    lines = told("that always says the look before")

    assert [_read(said)["led"] for said in lines] == [0, *range(len(TRUE) - 1)]


def _read(lines: list[bytes]) -> probes.Look:
    (said,) = lines
    return next(look for look in TRUE if probes.line(look) == said)


def test_a_probe_that_lags_says_what_was_seen_so_long_ago() -> None:
    past = probes.Past(10.0)
    for number, look in enumerate(TRUE):
        past.saw(look, number)
        assert past.look(number)["led"] == max(0, number - 10)


@pytest.mark.waits
@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.0, 0.1])
def test_a_lying_probe_is_asked_as_the_true_one_is(lag: float) -> None:
    lie = probes.Lie(probes._flips(1.0), lag)
    with served() as robot, probes.LyingProbe(robot.probe.name, lie, Random(1)) as lying:
        asked = Probe(lying.name)
        look = asked.look()
        asked.close()

        assert look == {**robot.probe.look(), "moving": True}


# -- processes that are stopped -------------------------------------------------------------------


@pytest.mark.waits
def test_a_process_is_stopped_again_and_again_and_goes_on_in_the_end() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with pauses.stopped(process, 0.05, 0.1):
            for stop in (True, False, True):
                _wait(lambda stop=stop: is_suspended(process.pid) == stop)
        _wait(lambda: not is_suspended(process.pid))
        process.communicate(b"\n", PATIENCE)

        assert process.returncode == 0


def _wait(what: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < give_up
        time.sleep(0.002)


@pytest.mark.sample(0)
@pytest.mark.waits
@pytest.mark.slow
def test_a_wrong_judgement_of_paused_traffic_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The answers of the faulty device are none too few, and a device without faults is good."""
    monkeypatch.setattr(pauses, "_PAUSE", 0.2)
    monkeypatch.setattr(pauses, "_WRONG", 0.0)

    assert pauses.sniffed(1, good=True) == ""
    assert "exit 0" in pauses.sniffed(1, good=False)


# -- outputs that do not block --------------------------------------------------------------------

SAYS = """
import os, select, sys
data = b"line\\n" * 2000
while data:
    {}
    data = data[os.write(1, data[:100]):]
"""


@pytest.mark.waits
@pytest.mark.parametrize(
    ("script", "said"),
    [
        (SAYS.format("select.select([], [1], [])"), ""),
        (SAYS.format("pass"), "exit 1, and 0 on a pipe that blocks; 0 bytes shown of 9999"),
    ],
)
def test_output_that_a_pipe_does_not_take_at_once_is_seen_to_be_lost(
    script: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = nonblocking.Command(lambda port, folder: [sys.executable, "-c", script])
    monkeypatch.setitem(nonblocking.COMMANDS, "planted", planted)
    monkeypatch.setattr(nonblocking, "_STALLED", (0.5, 0.5))

    found = nonblocking.differs("planted", 1)

    assert said in found
    assert bool(found) == bool(said)


# -- a disk that is full as a part is closed ------------------------------------------------------


@pytest.mark.waits
@pytest.mark.slow
@pytest.mark.parametrize("form", seams.FORMS)
def test_what_a_full_disk_costs_of_a_recording_is_seen(
    form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard = seams.heard
    monkeypatch.setattr(
        seams, "heard", lambda path: {tap: data[:-1] for tap, data in heard(path).items()}
    )
    monkeypatch.setattr(seams, "_end", lambda: 1)

    assert "bytes were captured" in seams.filled(form, 1)
