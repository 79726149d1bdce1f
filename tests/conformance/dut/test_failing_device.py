"""Devices that hang, send without end, disappear or reboot in the middle of a run."""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import tracemalloc
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import pytest

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import DeviceError, device_target
from bilprov.conformance.learning.learner import learn_target
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol
from tests.support.commands import process
from tests.support.robots import MS, PATIENCE

BOOT = 300 * MS
SMOKE = Options(level="smoke", only=("pipelined/tour/*", "valid/LED/*"))


class Moody:
    """The reference until so many bytes have come to it; then something happens once."""

    def __init__(self, protocol: Protocol, after: int) -> None:
        self.robot = Simulator(protocol)
        self.left = after
        self.deaf_until = 0

    def happens(self, now: int) -> None:
        """What happens when the last of these bytes has come."""

    def receive(self, data: bytes, now: int) -> None:
        before, self.left = self.left, self.left - len(data)
        if before > 0 >= self.left:
            self.happens(now)
        if now >= self.deaf_until:
            self.robot.receive(data, now)

    def advance(self, now: int) -> bytes:
        return self.robot.advance(now)

    def deadline(self) -> int | None:
        return self.robot.deadline()

    def look(self, now: int) -> Look:
        return self.robot.look(now)


class Flooding(Moody):
    """A byte every 100 us, without end."""

    begun: int | None = None

    def happens(self, now: int) -> None:
        self.begun = now

    def advance(self, now: int) -> bytes:
        sent = super().advance(now)
        if self.begun is None:
            return sent
        count = max(0, (now - self.begun) // (MS // 10))
        self.begun += count * (MS // 10)
        return sent + b"\x00" * min(count, 1000)

    def deadline(self) -> int | None:
        due = super().deadline()
        if self.begun is None:
            return due
        own = self.begun + MS // 10
        return own if due is None else min(due, own)


class Rebooting(Moody):
    """Loses what it knew, and hears nothing for a while."""

    def happens(self, now: int) -> None:
        self.robot.power_cycle(now)
        self.deaf_until = now + BOOT


def run(protocol: Protocol, kind: Callable[[Protocol, int], Moody], after: int) -> Report:
    return conform(kind(protocol, after), grammar=protocol, options=SMOKE)


def counted(protocol: Protocol) -> int:
    """How many bytes the same run sends if nothing happens."""
    robot = Moody(protocol, 0)
    conform(robot, grammar=protocol, options=SMOKE)
    return -robot.left


def of(report: Report, verdict: Verdict) -> list[str]:
    return [result.id for result in report.results if result.verdict is verdict]


@pytest.mark.slow
def test_one_that_floods_fails_and_is_not_listened_to_for_ever(protocol: Protocol) -> None:
    after = counted(protocol) * 3 // 4
    tracemalloc.start()
    report = run(protocol, Flooding, after)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    failed = [result for result in report.results if result.verdict is Verdict.FAIL]

    assert report.exit == 1
    assert 0 < len(failed) <= 4
    readings = {axis.reading for result in failed for axis in result.axes.values()}
    assert "R-unsolicited" in readings, failed
    assert of(report, Verdict.PASS)
    assert most < 64 << 20


def test_one_that_floods_is_not_learned_and_the_reason_is_given(protocol: Protocol) -> None:
    learned = learn_target(device_target(protocol, Flooding(protocol, 1)))

    assert learned.trouble == "the device sends without end and without being asked"


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize("share", [0.06, *(n / 10 for n in range(1, 10)), 0.96])
def test_one_that_reboots_ends_by_itself_and_keeps_what_was_judged(
    protocol: Protocol, share: float
) -> None:
    """It happens once: nothing is reproduced, so nothing fails, and nothing is hidden."""
    report = run(protocol, Rebooting, int(counted(protocol) * share))

    assert report.exit == 3
    assert not of(report, Verdict.FAIL)
    assert of(report, Verdict.PASS)
    assert of(report, Verdict.INCONCLUSIVE)


# -- a line that is lost --------------------------------------------------------------------------

LAST = 400  # bytes that the device still takes: the opening's, and those of some cases


def served(robot: Moody, descriptor: int) -> None:
    """The device behind a descriptor, until it has taken its last byte."""
    clock = 0
    while robot.left > 0:
        ready = select.select([descriptor], [], [], 0.02)[0]
        clock += MS if ready else 60 * MS
        if ready:
            robot.receive(os.read(descriptor, 64), clock)
        os.write(descriptor, robot.advance(clock))


@contextmanager
def in_a_thread(serve: Callable[[], None]) -> Iterator[None]:
    """Serve in a thread, which has ended at the end of the block."""
    thread = threading.Thread(target=serve)
    thread.start()
    yield
    thread.join(PATIENCE)
    assert not thread.is_alive()


@contextmanager
def behind_a_socket(robot: Moody, *, reset: bool) -> Iterator[str]:
    """The URL of the device behind a connection that it closes, or resets, at its last byte."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            peer, _ = listener.accept()
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", reset, 0))
            with peer, suppress(OSError):
                served(robot, peer.fileno())

        with in_a_thread(serve):
            yield f"socket://127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def behind_a_pty(robot: Moody) -> Iterator[str]:
    """The name of a pty whose other side goes away after the device's last byte."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)

    def serve() -> None:
        with suppress(OSError):
            served(robot, ours)
        os.close(ours)

    with in_a_thread(serve):
        yield os.ttyname(theirs)
    os.close(theirs)


LINES = {
    "a socket that is closed": partial(behind_a_socket, reset=False),
    "a socket that is reset": partial(behind_a_socket, reset=True),
    "a pty that is gone": behind_a_pty,
}


@pytest.mark.waits
@pytest.mark.sample(1)
@pytest.mark.parametrize("fault", ["", "ok-to-unknown-id"])
@pytest.mark.parametrize("line", LINES)
def test_a_line_that_is_lost_ends_the_run_and_what_was_judged_is_in_every_report(
    protocol: Protocol, tmp_path: Path, line: str, fault: str
) -> None:
    """Exit status 2, but 1 where a case had failed before."""
    robot = Moody(protocol, LAST)
    robot.robot = Simulator(protocol, fault_bank(protocol)[fault] if fault else None)
    asked = {name: tmp_path / name for name in ("json", "junit", "markdown", "html")}
    files = [word for name, file in asked.items() for word in (f"--{name}", str(file))]
    with LINES[line](robot) as port:
        done = process("conform", port, "--yes", "--level", "smoke", *files)

    assert b"Traceback" not in done.stderr
    told = msgspec.json.decode(asked["json"].read_bytes())
    assert done.returncode == told["exit"] == (1 if fault else 2)
    assert told["ended_by"] == "error"
    assert port in told["ended"]
    assert "\n" not in told["ended"]
    counts = told["counts"]
    assert counts["pass"] > 3
    assert (counts["fail"] > 0) is bool(fault)
    assert counts["inconclusive"] > 10
    assert counts["error"] == 1
    (error,) = (case for case in told["cases"] if case["verdict"] == "error")
    assert [axis["reason"] for axis in error["axes"].values() if axis["reason"]]
    junit = ElementTree.fromstring(asked["junit"].read_bytes())
    assert len(junit.findall(".//testcase/error")) == 1
    assert len(junit.findall(".//testcase/failure")) == counts["fail"]
    assert told["ended"] in asked["markdown"].read_text().replace("<!-- -->", "")
    page = asked["html"].read_text()
    assert told["ended"] in page
    assert page.endswith("</html>\n")


# -- device objects that break their contract ------------------------------------------------------


FEW = Options(only=("valid/LED/*",))


class Own:
    """The reference device as somebody's own object, broken in one way."""

    def __init__(self, protocol: Protocol, **broken: Any) -> None:
        device = Simulator(protocol)
        for name in ("receive", "advance", "deadline", "look"):
            setattr(self, name, broken.get(name, getattr(device, name)))


def raising(*arguments: object) -> None:
    raise KeyError("x\x1b")


BROKEN = [
    (
        {"look": lambda now: None},
        "the device's look gave None; it must give an instance of bilprov.Look",
    ),
    ({"look": lambda now: {"moving": True}}, "the device's look gave {'moving': True}"),
    ({"advance": lambda now: "\0"}, "the device's advance gave '\\x00'; it must give bytes"),
    ({"advance": lambda now: None}, "the device's advance gave None"),
    ({"deadline": lambda: 1.5}, "the device's deadline gave 1.5"),
    ({"deadline": lambda: -1}, "the device's deadline gave -1 again after advance("),
    ({"receive": raising}, "the device's receive raised KeyError: 'x"),
    ({"look": lambda: CarLook(t=0, moving=False)}, "the device's look raised TypeError"),
    ({"deadline": None}, "the device object Own has no method deadline"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("broken", "words"), BROKEN, ids=[words for _, words in BROKEN])
def test_the_method_is_named(protocol: Protocol, broken: dict[str, Any], words: str) -> None:
    device: Any = Own(protocol, **broken)

    with pytest.raises(DeviceError) as raised:
        conform(device, grammar=protocol, options=FEW)

    assert str(raised.value).startswith(words)
    assert str(raised.value).isprintable()
