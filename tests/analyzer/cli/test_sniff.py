"""`bilprov sniff` on real ptys: it shows and records exactly the bytes that were sent."""

from __future__ import annotations

import json
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.transport.port import PtyPair, open_port, open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Line
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.analyzer.cli.sniffing import Sniffing, kept, promptly, sniffing, write
from tests.support import commands
from tests.support.commands import running
from tests.support.messages import messages
from tests.support.robots import RecordingRobot, served_here, until
from tests.support.wires import json_lines

pytestmark = pytest.mark.waits

TROUBLESOME = bytes([0x00, 0x03, 0x04, 0x11, 0x13, 0x1A, 0x7F, 0xFF])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def replayed(path: Path, *more: str) -> commands.Done:
    return commands.command("replay", str(path), "--rate", "0", "--format", "jsonl", *more)


def test_bytes_sniffed_equal_bytes_sent_and_a_replay_says_the_same(path: Path) -> None:
    said = TROUBLESOME * 4 + bytes(range(256)) + bytes(16)
    answered = TROUBLESOME + bytes(range(256))
    with sniffing(path) as one:
        for at in range(0, len(said), 7):
            write(one.host, said[at : at + 7])
            write(one.device, answered[at : at + 7])
        output, heard = b"", 0
        while heard < len(answered):  # a response's line is the last thing that its byte does
            output += (line := one.lines())
            heard += b'"response"' in line
        code, rest, err = one.command.end()
    output += promptly(rest)

    assert code == 0, err
    sides = {"host": said, "device": answered}
    assert {side: kept(path, side) for side in sides} == sides
    lines = json_lines(output)
    for side, data in sides.items():
        shown = " ".join(line["hex"] for line in lines if line["direction"] == side)
        assert bytes.fromhex(shown) == data
    again = replayed(path)
    assert (promptly(again.stdout), again.returncode) == (output, 0)


def test_the_capture_holds_what_was_decoded_too(path: Path) -> None:
    with sniffing(path, "--count", "2") as one:
        write(one.host, b"\x81\x09")
        one.lines()
        write(one.device, b"\x00")
        code, _, _ = one.command.result()

    assert code == 0
    capture = open_capture(path)
    topics: dict[str, list[Any]] = {}
    for message in messages(capture):
        topics.setdefault(message.topic, []).append(message.value)
    assert topics["/host/instructions"][0]["name"] == "LED"
    assert topics["/device/responses"][0]["agrees"] is False
    assert topics["/state"][0]["motion"] == "stopped"
    names = {fault["name"] for fault in topics["/faults"]} - {"waited"}  # of a busy machine
    assert names == {"faulty instruction", "disagreeing"}
    assert {line["event"] for line in topics["/line"]} - {"waited"} == {"open", "close"}
    assert {"grammar_sha256", "port_host", "line", "truncation_timeout_ms"} <= set(capture.metadata)
    assert (capture.metadata["attached"], capture.unfinished) == ("yes", False)


@pytest.mark.parametrize(
    ("words", "said", "shown"),
    [
        ("--count 2 --filter speed>0", "20 1101 00 1102 1103", ["11 01", "11 02"]),
        ("--count 1 --filter sound<4 --grammar HORN", "9107 9103", ["91 03"]),
        ("--duration 1", "20", ["20"]),
    ],
)
def test_the_host_alone_is_heard_and_what_was_asked_for_is_shown(
    path: Path, horn_text: str, words: str, said: str, shown: list[str]
) -> None:
    horn = path.with_name("horn.py")
    horn.write_text(horn_text)
    with sniffing(path, *words.replace("HORN", str(horn)).split(), taps=1) as one:
        write(one.host, bytes.fromhex(said))
        code, out, _ = one.command.result()

    assert code == 0
    heard = [line for line in json_lines(out) if line["hex"]]  # a busy machine may report a wait
    assert [(line["hex"], line["faults"]) for line in heard] == [(h, []) for h in shown]


def test_unplugged_taps_are_told_and_what_was_captured_is_kept(path: Path) -> None:
    with sniffing(path, "--judge") as one:
        for pair, data in ((one.host, b"\x20"), (one.device, b"\x00")):
            write(pair, data)
            one.lines()
        one.device.close()
        at_once = one.error()
        shown = one.lines()
        write(one.host, b"\x11\x07")
        shown += one.lines()
        time.sleep(0.5)  # longer than any answer takes
        write(one.host, b"\x11\x08")
        shown += one.lines()
        one.host.close()
        code, rest, err = one.command.result()

    assert code == 2
    assert at_once.startswith("bilprov: listening goes on without the device: ")
    faults = [line["faults"] for line in json_lines(shown)]
    assert faults == [["unplugged"], [], []]  # and nothing is unanswered
    assert not json_lines(rest)[-1]["violations"]
    sentence = err.decode().splitlines()[-1]
    assert sentence.startswith("bilprov: ")
    assert all(name in sentence for name in (one.host.name, one.device.name, str(path)))
    assert kept(path) == b"\x20\x11\x07\x11\x08"
    assert not open_capture(path).unfinished
    assert shown in promptly(replayed(path).stdout)


@contextmanager
def _plugged(link: Path) -> Iterator[PtyPair]:
    """A port under the path that is always its own."""
    with open_pty() as pair:
        link.unlink(missing_ok=True)
        link.symlink_to(pair.name)
        yield pair


@pytest.mark.parametrize(("more", "expected"), [((), 2), (("--wait",), 0)])
def test_a_tap_that_is_plugged_in_again_is_heard_again(
    path: Path, more: tuple[str, ...], expected: int
) -> None:
    link = path.with_name("tap")
    with ExitStack() as stack:
        device = stack.enter_context(_plugged(link))
        host = stack.enter_context(open_pty())
        one = stack.enter_context(sniffing(path, host.name, str(link), *more, taps=0))
        device.close()
        assert str(link) in one.error()
        write(host, b"\x20")
        one.row('"20"')
        device = stack.enter_context(_plugged(link))
        assert "is there again" in one.error()
        write(host, b"\x11\x07")
        said = one.row('"11 07"')
        write(device, b"\x00")
        (answer,) = json_lines(one.lines())
        code, _, err = one.command.end()

    assert code == expected, err
    assert (answer["agrees"], answer["answers"]) == (True, said["sequence"])
    events = [event.event for event in open_capture(path) if isinstance(event, Line)]
    events = [event for event in events if event != "waited"]
    assert events == ["open", "unplugged", "reconnected", "close"]


@pytest.mark.parametrize("option", ["", "--bridge"])
def test_with_wait_a_port_may_come_late_and_again(path: Path, option: str) -> None:
    link = path.with_name("port")
    words = [option] * bool(option) + [str(link), "-w", str(path), "--format", "jsonl", "--wait"]
    with ExitStack() as stack, running("sniff", *words) as command:
        one = Sniffing(*[stack.enter_context(open_pty()) for _ in range(2)], command, path)
        assert "; waiting\n" in one.error()
        for turn in range(2):
            port = stack.enter_context(_plugged(link))
            if turn:
                assert "is there again" in one.error()
            else:
                if option:
                    host = stack.enter_context(open_port(one.error().strip()))
                command.wait_for(path)
            if option:
                host.write(b"\x20")
                while not port.read():
                    time.sleep(0.005)
            write(port, b"\x00" if option else b"\x20")
            one.row('"20"')
            if option:
                one.row("response")
            port.close()
            assert "bilprov: waiting for the " in one.error()
        code, _, err = command.end()

    assert code == 2
    assert str(link) in err.decode().splitlines()[-1]
    assert kept(path) == b"\x20" * 2
    assert not open_capture(path).unfinished


def test_what_is_waited_for_may_never_come(tmp_path: Path) -> None:
    with running("sniff", str(tmp_path / "port"), "--wait") as command:
        assert b"; waiting\n" in command.stderr.readline()
        code, out, err = command.end()

    assert (code, out, err) == (0, b"", b"")


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("fault", "form", "words"),
    [
        (Sniffing.fill_disk, "jsonl", "disk full: what was captured until "),
        (Sniffing.fill_disk, "lines", "disk full: what was captured until "),
        (lambda one: one.path.unlink(), "jsonl", "was deleted while recording"),
        (
            lambda one: os.truncate(one.path, one.path.stat().st_size - 100),
            "jsonl",
            "another program made the capture file ",
        ),
    ],
)
def test_a_capture_that_fails_is_said_at_once_and_at_the_end_and_decoding_goes_on(
    path: Path, fault: Callable[[Sniffing], object], form: str, words: str
) -> None:
    with sniffing(path, form=form) as one:
        write(one.host, b"\x20")
        one.lines()
        until(lambda: path.stat().st_size and kept(path) == b"\x20")
        fault(one)
        write(one.host, b"\x11\x07")
        at_once = one.error()  # while it runs
        write(one.host, b"\x81\x05")
        while b"81 05" not in one.lines():
            pass
        code, _, err = one.command.end()

    (*totals, sentence) = err.decode().splitlines()
    assert code == 2
    assert words in sentence
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert str(path) not in "".join(totals)
    assert "Traceback" not in err.decode()
    if fault is Sniffing.fill_disk:
        assert kept(path) == b"\x20"
        assert (open_capture(path).unfinished, open_capture(path).damage) == (True, ())


@pytest.mark.parametrize("full", [False, True])
def test_a_bridge_passes_every_byte_also_where_the_disk_is_full(
    path: Path, protocol: Protocol, full: bool
) -> None:
    robot = RecordingRobot(protocol)
    with (
        served_here(robot, pty=True) as (port, _),
        sniffing(path, "--bridge", port, "--yes", taps=0) as one,
        open_port(one.error().strip()) as host,
    ):
        if full:
            one.fill_disk()
        answers = b""
        for frame in (b"\x11\xff", b"\x20", b"\x81\x09"):
            host.write(frame)
            lines = json_lines(one.lines(2))
            assert [line["kind"] for line in lines] == ["instruction", "response"]
            assert lines[1]["agrees"] is True
            answer = b""
            while not answer:
                answer = host.read()
            answers += answer
        code, _, err = one.command.end()

    assert robot.heard == [b"\x11\xff", b"\x20", b"\x81\x09"]
    assert answers == b"\x00\x00\x02"
    assert (code, b"disk full" in err) == (2 * full, full)
    assert open_capture(path).metadata["attached"] == "no"


def test_the_capture_is_finished_though_nobody_reads_the_text(path: Path) -> None:
    with sniffing(path) as one:
        write(one.host, b"\x20")
        one.lines()
        write(one.host, TROUBLESOME * 1000)  # more text than a pipe takes
        until(lambda: len(kept(path)) == 8001)
        one.command.process.send_signal(signal.SIGINT)
        until(lambda: not open_capture(path).unfinished)

        assert one.command.process.poll() is None
        code, out, _ = one.command.result()

    assert code == 0
    assert out.endswith(b"}\n")


STOPPED = 1.2  # s; longer than a device may take to answer


def test_a_good_device_is_good_though_the_sniffer_was_stopped(
    path: Path, protocol: Protocol
) -> None:
    frames = [b"\x20", b"\x81\x09", b"\x00", b"\xf0", b"\x11\x01"] * 40
    with sniffing(path, "--judge") as one:
        time.sleep(0.1)  # silence, after which a byte begins a frame
        process, kinds = one.command.process, Counter[str]()
        for number, frame in enumerate(frames):
            write(one.host, frame)
            if number == 50:  # between the frame and its answer
                while kinds["instruction"] <= number:
                    kinds[json.loads(one.lines())["kind"]] += 1
                process.send_signal(signal.SIGSTOP)
                os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
            write(one.device, bytes([judge(protocol, frame).response.code]))
            time.sleep(STOPPED if number == 50 else 0.005)
            if number == 60:
                process.send_signal(signal.SIGCONT)
        while kinds["response"] < len(frames):
            kinds[json.loads(one.lines())["kind"]] += 1
        code, out, err = one.command.end()

    findings = json_lines(out)[-1]
    assert (code, findings["violations"], findings["not_judged"]) == (0, {}, {}), (findings, err)
    assert findings["judged"] == len(frames)
    assert findings["unread"] >= STOPPED * 1e9
    assert any(isinstance(e, Line) and e.event == "waited" for e in open_capture(path))
    assert json_lines(replayed(path, "--judge").stdout)[-1] == findings


def test_the_name_of_a_port_prints(tmp_path: Path) -> None:
    link = tmp_path / "a\x1b[2Jb"
    with open_pty() as pair:
        link.symlink_to(pair.name)
        done = commands.process("sniff", str(link), "--duration", "0.1", "--format", "lines")

    assert done.returncode == 0
    assert b"a\\x1b[2Jb" in done.stdout
    assert b"\x1b" not in done.stdout + done.stderr
