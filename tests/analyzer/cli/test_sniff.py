"""`bilprov sniff` on real ptys: it shows and records exactly the bytes that were sent."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.pty import PtyPair, open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Line
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support import commands
from tests.support.wires import PATIENCE, PtyRobot, Running, json_lines, running, served

pytestmark = pytest.mark.waits

TROUBLESOME = bytes([0x00, 0x03, 0x04, 0x11, 0x13, 0x1A, 0x7F, 0xFF])


def _kept(path: Path, direction: str) -> bytes:
    return b"".join(
        event.data
        for event in open_capture(path)
        if isinstance(event, Chunk) and event.direction == direction
    )


def _write(pair: PtyPair, data: bytes) -> None:
    """What another program says on the line: the sniffer hears it on the pty's path."""
    while data:
        try:
            data = data[os.write(pair.master, data) :]
        except BlockingIOError:
            time.sleep(0.001)


def _read(command: Running, count: int) -> list[bytes]:
    """The next lines of standard output, as they come."""
    lines = [command.stdout.readline() for _ in range(count)]
    assert all(lines), command.stderr.read()
    return lines


def _shown(command: Running, words: str) -> dict[str, Any]:
    """The next JSON line with these words."""
    while words.encode() not in (line := b"".join(_read(command, 1))):
        pass
    return json_lines(line)[0]


def _taps(tmp_path: Path, host: PtyPair, device: PtyPair, *more: str) -> tuple[list[str], Path]:
    path = tmp_path / "run.mcap"
    return ["sniff", host.name, device.name, "-w", str(path), "--format", "jsonl", *more], path


def test_bytes_sniffed_equal_bytes_sent_and_a_replay_says_the_same(tmp_path: Path) -> None:
    said = TROUBLESOME * 4 + bytes(range(256)) + bytes(16)
    answered = TROUBLESOME + bytes(range(256))
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device)
        with running(*arguments) as command:
            command.wait_for(path)
            for at in range(0, len(said), 7):
                _write(host, said[at : at + 7])
                _write(device, answered[at : at + 7])
            shown: list[bytes] = []
            heard = 0
            while heard < len(answered):  # a response's line is the last thing that its byte does
                shown += _read(command, 1)
                heard += b'"response"' in shown[-1]
            code, rest, err = command.end()
    output = b"".join(shown) + rest

    assert code == 0, err
    assert _kept(path, "host") == said
    assert _kept(path, "device") == answered
    lines = json_lines(output)
    host_hex = " ".join(line["hex"] for line in lines if line["direction"] == "host")
    device_hex = " ".join(line["hex"] for line in lines if line["direction"] == "device")
    assert bytes.fromhex(host_hex) == said
    assert bytes.fromhex(device_hex) == answered

    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")

    assert replayed.stdout == output
    assert replayed.returncode == 0


def test_unanswered_instructions_are_reported_live_as_on_replay(tmp_path: Path) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device)
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x20\x11")
            lines = _read(command, 3)  # Forward, Speed cut short, no answer to the first
            code, rest, _ = command.end(signal.SIGTERM)

    assert code == 0
    assert json_lines(lines[2])[0]["faults"] == ["unanswered"]
    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")
    assert replayed.stdout == b"".join(lines) + rest


def test_the_capture_holds_what_was_decoded_too(tmp_path: Path) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device, "--count", "2")
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x81\x09")
            _read(command, 1)
            _write(device, b"\x00")
            code, _, _ = command.result()

    assert code == 0
    capture = open_capture(path)
    topics: dict[str, list[Any]] = {}
    for message in capture.messages():
        topics.setdefault(message.topic, []).append(message.value)
    assert topics["/host/instructions"][0]["name"] == "LED"
    assert topics["/device/responses"][0]["agrees"] is False
    assert topics["/state"][0]["motion"] == "stopped"
    assert {fault["name"] for fault in topics["/faults"]} == {"faulty instruction", "disagreeing"}
    assert {line["event"] for line in topics["/line"]} == {"open", "close"}
    for key in ("grammar_name", "grammar_sha256", "port_host", "line", "truncation_timeout_ms"):
        assert capture.metadata[key]
    assert capture.metadata["attached"] == "yes"
    assert not capture.unfinished


def test_count_counts_the_frames_that_a_filter_lets_pass(tmp_path: Path) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device, "--count", "2", "--filter", "speed > 0")
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x20\x11\x01\x00\x11\x02\x11\x03")
            code, out, _ = command.result()

    assert code == 0
    assert [line["hex"] for line in json_lines(out)] == ["11 01", "11 02"]


def test_duration_ends_it(tmp_path: Path) -> None:
    with open_pty() as host:
        run = commands.command("sniff", host.name, "--duration", "0.1", "--format", "lines")

    assert run.returncode == 0


def test_the_host_alone_can_be_tapped_and_is_not_said_to_go_unanswered(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        open_pty() as host,
        running(
            "sniff", host.name, "-w", str(path), "--format", "jsonl", "--duration", "2"
        ) as command,
    ):
        command.wait_for(path)
        _write(host, b"\x20")
        code, out, _ = command.result()

    assert code == 0
    assert [line["faults"] for line in json_lines(out)] == [[]]


def test_when_the_last_tap_is_unplugged_it_ends_and_what_was_captured_is_kept(
    tmp_path: Path,
) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device)
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x20")
            _read(command, 1)
            device.close()
            at_once = command.stderr.readline().decode()
            host.close()
            code, _, err = command.result()

    assert code == 2
    sentence = err.decode().splitlines()[-1]
    assert at_once.startswith("bilprov: listening goes on without the device: ")
    assert sentence.startswith("bilprov: ")
    assert all(name in sentence for name in (host.name, device.name, str(path)))
    assert _kept(path, "host") == b"\x20"
    assert not open_capture(path).unfinished


def test_when_one_tap_is_unplugged_the_other_is_heard_on_and_nothing_is_unanswered(
    tmp_path: Path,
) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device, "--judge")
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x20")
            _read(command, 1)
            _write(device, b"\x00")
            _read(command, 1)
            device.close()
            assert device.name.encode() in command.stderr.readline()
            shown = b"".join(_read(command, 1))
            _write(host, b"\x11\x07")
            shown += b"".join(_read(command, 1))
            time.sleep(0.5)  # longer than any answer takes
            _write(host, b"\x11\x08")
            shown += b"".join(_read(command, 1))
            code, rest, err = command.end()

    assert code == 2
    assert [line["faults"] for line in json_lines(shown)] == [["unplugged"], [], []]
    (judgement,) = json_lines(rest)
    assert not judgement["violations"], judgement
    assert device.name in err.decode().splitlines()[-1]
    assert _kept(path, "host") == b"\x20\x11\x07\x11\x08"
    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")
    assert replayed.stdout.endswith(shown)


@contextmanager
def _plugged(link: Path) -> Iterator[PtyPair]:
    """A port under the path that is always its own."""
    with open_pty() as pair:
        link.unlink(missing_ok=True)
        link.symlink_to(pair.name)
        yield pair


@pytest.mark.parametrize(("more", "expected"), [((), 2), (("--wait",), 0)])
def test_a_tap_that_is_plugged_in_again_is_heard_again(
    tmp_path: Path, more: tuple[str, ...], expected: int
) -> None:
    path, link = tmp_path / "run.mcap", tmp_path / "tap"
    arguments = ["-w", str(path), "--format", "jsonl", *more]
    with open_pty() as host, ExitStack() as stack:
        device = stack.enter_context(_plugged(link))
        with running("sniff", host.name, str(link), *arguments) as command:
            command.wait_for(path)
            device.close()
            assert str(link).encode() in command.stderr.readline()
            _write(host, b"\x20")
            _shown(command, '"20"')
            device = stack.enter_context(_plugged(link))
            assert b"is there again" in command.stderr.readline()
            _write(host, b"\x11\x07")
            said = _shown(command, '"11 07"')
            _write(device, b"\x00")
            (answer,) = json_lines(b"".join(_read(command, 1)))
            code, _, err = command.end()

    assert code == expected, err
    assert (answer["agrees"], answer["answers"]) == (True, said["sequence"])
    events = [event.event for event in open_capture(path) if isinstance(event, Line)]
    assert events == ["open", "unplugged", "reconnected", "close"]


@pytest.mark.parametrize("option", ["", "--bridge"])
def test_with_wait_a_port_may_come_late_and_again(tmp_path: Path, option: str) -> None:
    path, link = tmp_path / "run.mcap", tmp_path / "port"
    words = [option] * bool(option) + [str(link), "-w", str(path), "--format", "jsonl", "--wait"]
    with ExitStack() as stack, running("sniff", *words) as command:
        assert b"; waiting\n" in command.stderr.readline()
        for turn in range(2):
            port = stack.enter_context(_plugged(link))
            if turn:
                assert b"is there again" in command.stderr.readline()
            elif option:
                name = command.stderr.readline().decode().strip()
                host = stack.enter_context(open_port(name))
            if not turn:
                command.wait_for(path)
            if option:
                host.write(b"\x20")
                while not port.read():
                    time.sleep(0.005)
            _write(port, b"\x00" if option else b"\x20")
            _shown(command, '"20"')
            if option:
                _shown(command, "response")
            port.close()
            assert b"bilprov: waiting for the " in command.stderr.readline()
        code, _, err = command.end()

    assert code == 2
    assert str(link) in err.decode().splitlines()[-1]
    assert _kept(path, "host") == b"\x20" * 2
    assert not open_capture(path).unfinished


def test_what_is_waited_for_may_never_come(tmp_path: Path) -> None:
    with running("sniff", str(tmp_path / "port"), "--wait") as command:
        assert b"; waiting\n" in command.stderr.readline()
        code, out, err = command.end()

    assert (code, out, err) == (0, b"", b"")


def _fills(command: Running, path: Path) -> None:
    """From now on the file system takes no byte more of the program, as a full disk."""
    size = path.stat().st_size
    resource.prlimit(command.process.pid, resource.RLIMIT_FSIZE, (size, size))


def _deletes(command: Running, path: Path) -> None:
    path.unlink()


def _cuts(command: Running, path: Path) -> None:
    os.truncate(path, path.stat().st_size - 100)


def _until_kept(path: Path, data: bytes) -> None:
    give_up = time.monotonic() + PATIENCE
    while not path.stat().st_size or _kept(path, "host") != data:
        assert time.monotonic() < give_up
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("fault", "form", "words"),
    [
        (_fills, "jsonl", "disk full: what was captured until "),
        (_fills, "lines", "disk full: what was captured until "),
        (_deletes, "jsonl", "was deleted while recording"),
        (_cuts, "jsonl", "another program made the capture file "),
    ],
)
def test_a_capture_that_fails_is_said_at_once_and_at_the_end_and_decoding_goes_on(
    tmp_path: Path, fault: Callable[[Running, Path], None], form: str, words: str
) -> None:
    path = tmp_path / "run.mcap"
    with (
        open_pty() as host,
        open_pty() as device,
        running("sniff", host.name, device.name, "-w", str(path), "--format", form) as command,
    ):
        command.wait_for(path)
        _write(host, b"\x20")
        _read(command, 1)
        _until_kept(path, b"\x20")
        fault(command, path)
        _write(host, b"\x11\x07")
        at_once = command.stderr.readline().decode()  # while it runs
        _write(host, b"\x81\x05")
        shown = b""
        while b"81 05" not in shown:
            shown += b"".join(_read(command, 1))
        code, _, err = command.end()

    (*totals, sentence) = err.decode().splitlines()
    assert code == 2
    assert words in sentence
    assert at_once == f"{sentence}; listening goes on, without recording\n"
    assert str(path) not in "".join(totals)
    assert "Traceback" not in err.decode()
    if fault is _fills:
        assert _kept(path, "host") == b"\x20"
        assert (open_capture(path).unfinished, open_capture(path).damage) == (True, ())


def test_a_quiet_log_on_a_full_disk_goes_on_counting(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        open_pty() as host,
        running("sniff", host.name, "-w", str(path), "--quiet", "--count", "101") as command,
    ):
        command.wait_for(path)
        _write(host, b"\x20")
        _until_kept(path, b"\x20")
        _fills(command, path)
        _write(host, b"\x11\x07")
        at_once = command.stderr.readline().decode()
        assert command.process.poll() is None
        _write(host, b"\x11\x08" * 99)
        code, _, err = command.result()

    totals, sentence = err.decode().splitlines()
    assert code == 2
    assert at_once.startswith(f"{sentence}; ")
    assert totals.startswith("101 instructions")


def test_a_bridge_hands_on_though_the_disk_is_full(tmp_path: Path, protocol: Protocol) -> None:
    path = tmp_path / "run.mcap"
    robot = PtyRobot(protocol)
    with (
        served(robot) as port,
        running("sniff", "--bridge", port, "-w", str(path), "--format", "jsonl") as command,
    ):
        name = command.stderr.readline().decode().strip()
        descriptor = os.open(name, os.O_RDWR | os.O_NOCTTY)
        try:
            _fills(command, path)
            os.write(descriptor, b"\x20")
            _read(command, 2)
            assert os.read(descriptor, 1) == b"\x00"
            assert b"disk full" in command.stderr.readline()
            os.write(descriptor, b"\x81\x09")
            _read(command, 2)
            assert os.read(descriptor, 1) == b"\x02"
        finally:
            os.close(descriptor)
        code, _, err = command.end()

    assert code == 2
    assert err.decode().splitlines()[-1].startswith("bilprov: disk full")


def test_a_reader_that_goes_ends_it_quietly(tmp_path: Path) -> None:
    with open_pty() as host:
        path = tmp_path / "run.mcap"
        with running("sniff", host.name, "-w", str(path), "--format", "jsonl") as command:
            command.wait_for(path)
            _write(host, b"\x20")
            _read(command, 1)
            command.stdout.close()
            _write(host, b"\x00\x00")
            command.process.wait(PATIENCE)
            err = command.stderr.read()

    assert command.process.returncode == 0
    assert b"Traceback" not in err
    assert b"Exception" not in err
    assert not open_capture(path).unfinished


def test_the_capture_is_finished_though_nobody_reads_the_text(tmp_path: Path) -> None:
    with open_pty() as host, open_pty() as device:
        arguments, path = _taps(tmp_path, host, device)
        with running(*arguments) as command:
            command.wait_for(path)
            _write(host, b"\x20")
            _read(command, 1)
            _write(host, TROUBLESOME * 1000)  # more text than a pipe takes
            give_up = time.monotonic() + PATIENCE
            while len(_kept(path, "host")) < 8001:
                assert time.monotonic() < give_up
            command.process.send_signal(signal.SIGINT)
            while open_capture(path).unfinished:
                assert time.monotonic() < give_up

            assert command.process.poll() is None
            code, out, _ = command.result()

    assert code == 0
    assert out.endswith(b"}\n")


def test_a_kill_loses_nothing_that_is_older_than_a_moment(tmp_path: Path) -> None:
    with open_pty() as host:
        path = tmp_path / "run.mcap"
        with running("sniff", host.name, "-w", str(path), "--format", "jsonl") as command:
            command.wait_for(path)
            before = path.stat().st_size
            _write(host, b"\x20\x00")
            give_up = time.monotonic() + PATIENCE
            while path.stat().st_size == before and time.monotonic() < give_up:
                time.sleep(0.01)
            while not _kept(path, "host") and time.monotonic() < give_up:
                time.sleep(0.05)
            command.process.kill()
            command.process.wait()

    replayed = commands.command("replay", str(path), "--rate", "0", "--format", "jsonl")
    assert replayed.returncode == 0
    assert [line["hex"] for line in json_lines(replayed.stdout)] == ["20", "00"]
    assert len(replayed.stderr.splitlines()) == 1
    assert b"never finished" in replayed.stderr


def test_a_bridge_passes_every_byte_and_names_its_pty(tmp_path: Path, protocol: Protocol) -> None:
    path = tmp_path / "run.mcap"
    robot = PtyRobot(protocol)
    with (
        served(robot) as port,
        running(
            "sniff", "--bridge", port, "--yes", "-w", str(path), "--format", "jsonl"
        ) as command,
    ):
        name = command.stderr.readline().decode().strip()
        descriptor = os.open(name, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, b"\x11\xff\x20\x81\x09")
            lines = json_lines(b"".join(_read(command, 6)))
            answers = os.read(descriptor, 100)
        finally:
            os.close(descriptor)
        code, _, _ = command.end()

    assert code == 0
    assert robot.frames == [b"\x11\xff", b"\x20", b"\x81\x09"]
    assert answers == b"\x00\x00\x02"
    assert [line["kind"] for line in lines] == ["instruction"] * 3 + ["response"] * 3
    assert [line["agrees"] for line in lines[3:]] == [True] * 3
    assert open_capture(path).metadata["attached"] == "no"


def test_a_capture_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with open_pty() as host:
        run = commands.command("sniff", host.name, "-w", str(path))

    assert run.returncode == 2
    assert path.read_bytes() == b"precious"


def test_another_grammar_is_followed(tmp_path: Path, horn_text: str) -> None:
    grammar, path = tmp_path / "horn.py", tmp_path / "run.mcap"
    grammar.write_text(horn_text, encoding="utf-8")
    with (
        open_pty() as host,
        running(
            *("--grammar", str(grammar), "sniff", host.name, "-w", str(path)),
            *("--format", "jsonl", "--filter", "sound < 4", "--count", "1"),
        ) as command,
    ):
        command.wait_for(path)
        _write(host, b"\x91\x07\x91\x03")
        code, out, _ = command.result()

    assert code == 0
    assert [line["hex"] for line in json_lines(out)] == ["91 03"]


WRONG_CLOCK = """
import sys, time
time.time_ns = lambda: -3_600 * 10**9
import bilprov
bilprov.main(sys.argv[1:])
"""


def test_a_clock_before_1970_is_noted_and_the_capture_begins_there(tmp_path: Path) -> None:
    with open_pty() as host:
        path = tmp_path / "run.mcap"
        words = ("sniff", host.name, "-w", str(path), "--duration", "0.1")
        result = commands.process(*words, code=WRONG_CLOCK)

    assert result.returncode == 0
    assert b"the clock of this computer is set to before 1970 or after 2262" in result.stderr
    assert open_capture(path).start == 0


STOPPED = 1.2  # s; longer than a device may take to answer


def test_a_good_device_is_good_though_the_sniffer_was_stopped(
    tmp_path: Path, protocol: Protocol
) -> None:
    frames = [b"\x20", b"\x81\x09", b"\x00", b"\xf0", b"\x11\x01"] * 40
    with open_pty() as host, open_pty() as device, ExitStack() as stack:
        arguments, path = _taps(tmp_path, host, device, "--judge")
        command = stack.enter_context(running(*arguments))
        command.wait_for(path)
        time.sleep(0.1)  # silence, after which a byte begins a frame
        shown: list[bytes] = []
        for number, frame in enumerate(frames):
            _write(host, frame)
            if number == 50:  # between the frame and its answer
                while sum(b'"instruction"' in line for line in shown) <= number:
                    shown += _read(command, 1)
                _stop(command)
            _write(device, bytes([judge(protocol, frame).response.code]))
            time.sleep(STOPPED if number == 50 else 0.005)
            if number == 60:
                command.process.send_signal(signal.SIGCONT)
        code, out, err = command.end()

    findings = json_lines(out)[-1]
    assert (code, findings["violations"], findings["not_judged"]) == (0, {}, {}), (findings, err)
    assert findings["judged"] == len(frames)
    assert findings["unread"] >= STOPPED * 1e9
    assert any(isinstance(e, Line) and e.event == "waited" for e in open_capture(path))
    replayed = commands.command("replay", str(path), "--rate", "0", "--judge", "--format", "jsonl")
    assert json_lines(replayed.stdout)[-1] == findings


def _stop(command: Running) -> None:
    """Stop the process, and return when it is stopped."""
    command.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, command.process.pid, os.WSTOPPED | os.WNOWAIT)
