"""Probes: what each one reports, and the message if one fails."""

from __future__ import annotations

import os
import re
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import msgspec
import pytest

from bilprov.analyzer.client.operations import Ended, Observe
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.probes import (
    ExecProbe,
    Probe,
    ProbeError,
    TcpProbe,
    open_probe,
    parse_look,
)
from bilprov.analyzer.transport.port import open_port, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.recheck import recheck
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command
from tests.support.robots import PATIENCE, ProbeServer, simulate

pytestmark = pytest.mark.waits


def look_of(probe: Probe) -> Look:
    """Ask and wait as the link does."""
    probe.ask()
    while True:
        fd = probe.fileno()
        if fd is not None:
            assert select.select([fd], [], [], PATIENCE)[0]
        look = probe.take(7)
        if look is not None:
            return look


# -- tcp ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "look"),
    [
        ('{"moving": true}', CarLook(7, True)),
        ('{"moving": null}', CarLook(7, None)),
        ("{}", CarLook(7, None)),
        ('{"moving": true, "battery": 7.2, "moods": [1]}', CarLook(7, True)),
        (
            '{"moving": true, "motion": "forward", "speed": 200.0, "steering": -3.6, "led": 5}',
            CarLook(7, True, motion="forward", speed=200, steering=-4, led=5),
        ),
        # A wheel that turns slowly still turns.
        ('{"moving": true, "left": 0.2, "right": -0.2}', CarLook(7, True, left=1, right=-1)),
        ('{"moving": false, "left": 0.0, "motion": null}\r', CarLook(7, False, left=0)),
    ],
)
def test_a_line_of_json_is_a_look(line: str, look: Look) -> None:
    assert parse_look(line.encode(), 7) == (look, None)


@pytest.mark.parametrize(
    "line",
    [
        *("", "moving", "true", "[]", "null", '{"moving": "yes"}', '{"moving": 1}'),
        *('{"moving": true', '{"speed": "fast"}', '{"motion": 3}', '{"moving": true} {}'),
        *("\xff\xfe", '{"moving": NaN}', "x" * 5000, '{"speed": true}', '[{"moving": true}]'),
        *('{"moving": true}\0', '{"speed": 1e300}', '{"mood": "\xff"}', '{"a":' * 10_000),
    ],
)
def test_what_is_not_such_a_line_is_refused_in_one_sentence(line: str) -> None:
    with pytest.raises(ProbeError, match="not a line of") as error:
        parse_look(line.encode("latin-1"), 0)

    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    "answer",
    [
        b'{"moving": true, "left": 123456789012345678901234567890}\n',
        b"{" + b" " * (1 << 20) + b"}\n",
    ],
    ids=["huge number", "a line of 1 MB"],
)
def test_the_run_ends_as_an_error_and_keeps_its_report_and_recording(
    tmp_path: Path, answer: bytes
) -> None:
    report, record = tmp_path / "run.json", tmp_path / "run.mcap"
    with simulate() as robot, ProbeServer(b'{"moving": false}\n', answer) as server:
        result = command(
            *("conform", robot.port, "--probe", server.name, "--yes", "--only", "valid/LED/1"),
            *("--json", str(report), "--record", str(record)),
        )

    assert b"Traceback" not in result.stderr
    assert result.returncode == 2, result.stderr
    document = msgspec.json.decode(report.read_bytes())
    assert (document["exit"], document["ended_by"]) == (2, "error")
    assert document["ended"].startswith("the probe ")
    assert "\n" not in document["ended"]
    assert document["cases"]  # what was judged until then
    assert recheck(str(record)).exit == 0


@contextmanager
def probing(*answers: bytes) -> Iterator[tuple[TcpProbe, ProbeServer]]:
    """A probe of a server that gives these answers."""
    with ProbeServer(*answers) as server:
        probe = TcpProbe(server.name.removeprefix("tcp:"))
        yield probe, server
        probe.close()


def test_one_connection_serves_the_whole_run() -> None:
    with probing(b'{"moving": true}\n', b'{"moving": false}\n') as (probe, server):
        assert [look_of(probe).moving for _ in range(3)] == [True, False, False]

    assert server.requests == [b"state\n"] * 3


def test_an_answer_may_come_in_pieces() -> None:
    with probing(b'{"moving"', b": true}\n") as (probe, _):
        probe.ask()
        assert select.select([probe.fileno()], [], [], PATIENCE)[0]
        assert probe.take(7) is None
        assert look_of(probe) == CarLook(7, True)


STOPPED, MOVING = b'{"moving": false}\n', b'{"moving": true}\n'


def settled_looks(probe: TcpProbe, count: int) -> list[bool | None]:
    """Looks, each asked for when all that the probe has sent for the last one is there."""
    looks = []
    for _ in range(count):
        looks.append(look_of(probe).moving)
        select.select([probe.fileno()], [], [], 0.05)  # a line too many, if there is one
    return looks


def test_a_probe_without_numbers_is_not_believed_after_a_line_too_many() -> None:
    """The line too many may come after the next question: then it would be its answer."""
    with probing(STOPPED, MOVING * 2, STOPPED, MOVING) as (probe, server):
        assert settled_looks(probe, 4) == [False, True, None, None]
        assert "sent 1 line more than it was asked for" in probe.remark
        assert "was ignored" in probe.remark

    assert set(server.requests) == {b"state\n"}


def test_lines_with_another_number_than_the_question_are_dropped() -> None:
    """Each line comes twice, and the second copy of the first only after the next question."""
    lines = [
        b'{"moving": %s, "number": %d}\n' % (b"true" if n % 2 else b"false", n) for n in range(5)
    ]
    late = [lines[0], lines[0] + lines[1] * 2, lines[2] * 2, lines[1] + lines[3], lines[4]]
    with probing(*late) as (probe, server):
        assert [look_of(probe).moving for _ in range(5)] == [False, True, False, True, False]
        assert probe.remark == (
            "the probe sent 4 lines more than it was asked for; they were dropped by their numbers"
        )

    assert server.requests == [b"state\n", *(b"state %d\n" % n for n in range(1, 5))]


def test_a_probe_that_answers_as_it_was_asked_is_no_remark() -> None:
    with probing(STOPPED, MOVING) as (probe, _):
        assert settled_looks(probe, 3) == [False, True, True]
        assert probe.remark == ""


def test_a_line_without_end_is_refused() -> None:
    with probing(b"x" * (1 << 17)) as (probe, _), pytest.raises(ProbeError, match="no end of line"):
        look_of(probe)


@pytest.fixture
def pty() -> Iterator[str]:
    with open_pty() as pair:
        yield pair.name


def observed(protocol: Protocol, pty: str, answer: bytes | None) -> object:
    """What a link gives for a look at a probe that answers so."""
    with ProbeServer(answer) as server, open_port(pty) as port, Stopper() as stopper:
        probe = open_probe(server.name, port, protocol)
        assert probe is not None
        with closing(probe):
            return PortLink(port, probe, stopper).do(Observe())


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"", "hung up"),
        (b"yes\n", "not a line of JSON"),
        (None, "did not answer in 1 s"),
    ],
)
def test_a_probe_that_fails_ends_the_run_but_not_the_line(
    protocol: Protocol, pty: str, answer: bytes | None, words: str
) -> None:
    with pytest.raises(Ended, match=words) as ended:
        observed(protocol, pty, answer)

    assert ended.value.error
    assert ended.value.line_works
    assert "\n" not in str(ended.value)


@pytest.mark.parametrize("patience", [0.02, 0.05])
def test_a_probe_that_stays_silent_is_given_up_at_its_own_limit(pty: str, patience: float) -> None:
    """The clock stands still until the limit is asked for: so no wait can be a shorter one."""
    asked: list[int] = []

    def clock() -> int:
        asked.append(0)
        return 0 if len(asked) < 5 else int(patience * 1e9) - (1 if len(asked) < 9 else 0)

    with ExitStack() as stack:
        silent = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        port = stack.enter_context(open_port(pty))
        stopper = stack.enter_context(Stopper())
        probe = TcpProbe(f"127.0.0.1:{silent.getsockname()[1]}")
        stack.callback(probe.close)
        probe.patience = patience

        with pytest.raises(Ended, match=rf"did not answer in {patience:g} s") as ended:
            PortLink(port, probe, stopper, clock=clock).do(Observe())

    assert ended.value.error
    assert len(asked) >= 9


def test_a_stop_ends_a_look_that_takes_long(pty: str) -> None:
    probe = ExecProbe("exec sleep 60")
    with closing(probe), open_port(pty) as port, Stopper() as stopper:
        stopper.stop()
        with pytest.raises(Ended, match="interrupted") as ended:
            PortLink(port, probe, stopper).do(Observe())

    assert (ended.value.by, ended.value.line_works) == ("user", True)


# -- exec -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shell", "moving"),
    [
        ("exit 0", False),
        ("echo moving; exit 0", False),
        (r"printf 'it is moving \377\300\0'; exit 1", True),
        ("exit 1", None),
        ("echo moving >&2; exit 1", None),
        ("echo moving; exit 2", None),
        ("kill -9 $$", None),
        ("head -c 1000000 /dev/zero; exit 1", None),
    ],
)
def test_a_commands_exit_code_and_output_tell(shell: str, moving: bool | None) -> None:
    probe = ExecProbe(f"({shell}) 2>/dev/null" if ">&2" in shell else shell)

    assert look_of(probe) == CarLook(7, moving)
    assert look_of(probe) == CarLook(7, moving)
    probe.close()


def test_a_command_that_cannot_be_run_is_said_so(tmp_path: Path) -> None:
    unreadable = tmp_path / "probe.txt"
    unreadable.write_text("not a program")
    for shell in ("/nowhere/probe 2>/dev/null", f"{unreadable} 2>/dev/null"):
        with pytest.raises(ProbeError, match="cannot be run"):
            look_of(ExecProbe(shell))


def test_a_command_that_is_given_up_is_ended() -> None:
    probe = ExecProbe("exec cat /dev/zero")
    probe.ask()
    process = probe._process
    assert process is not None

    probe.close()

    assert process.returncode == -9


# -- names ----------------------------------------------------------------------------------------


def test_none_is_no_probe(protocol: Protocol, pty: str) -> None:
    with open_port(pty) as port:
        assert open_probe("none", port, protocol) is None


# -- ask ------------------------------------------------------------------------------------------

QUESTION = re.compile(rb"Does the robot move now\? \[.*?\] ")


def test_a_person_who_answers_is_a_probe() -> None:
    """The person is this test: at each question it looks at the robot and types y or n."""
    questions = 0
    with simulate() as robot, open_pty() as terminal:
        slave = os.open(terminal.name, os.O_RDWR | os.O_NOCTTY)
        only = ["--only", "unused-id/9/[0-4]", "--only", "wrong-length/Stop/[0-5]"]
        asked = [sys.executable, "-m", "bilprov", "conform", "--probe", "ask", "--yes"]
        process = subprocess.Popen(
            [*asked, robot.port, "--truncation-timeout", "50", *only],
            stdin=slave,
            stderr=slave,
            stdout=subprocess.PIPE,
            cwd=ROOT,
        )
        os.close(slave)
        told = b""
        while process.poll() is None:
            if not select.select([terminal.master], [], [], 0.05)[0]:
                continue
            told += os.read(terminal.master, 4096)
            while match := QUESTION.search(told):
                told = told[match.end() :]
                questions += 1
                os.write(terminal.master, b"y\n" if robot.state()["moving"] else b"n\n")
        out, _ = process.communicate(timeout=PATIENCE)
        assert not robot.state()["moving"]

    assert process.returncode == 3, out  # what is not thorough was not looked at
    assert 8 <= questions <= 40
    assert b"fail" not in out
