"""Devices that hang, send without end, disappear or reboot in the middle of a run."""

from __future__ import annotations

import os
import select
import socket
import threading
import tracemalloc
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

from bilprov.captures.schemas import Look
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol
from tests.support.commands import process
from tests.support.robots import MS, PATIENCE

BOOT = 300 * MS
WALK = "pipelined/tour/*"
SMOKE = Options(level="smoke", only=(WALK, "valid/LED/*"))


class Moody:
    """The reference until so many bytes have come to it; then something happens once."""

    def __init__(self, protocol: Protocol, after: int) -> None:
        self.robot = Simulator(protocol)
        self.left = after

    def due(self, count: int) -> bool:
        """Whether it happens with these bytes."""
        before, self.left = self.left, self.left - count
        return before > 0 >= self.left

    def receive(self, data: bytes, now: int) -> None:
        self.robot.receive(data, now)

    def advance(self, now: int) -> bytes:
        return self.robot.advance(now)

    def deadline(self) -> int | None:
        return self.robot.deadline()

    def look(self, now: int) -> Look:
        return self.robot.look(now)


class Hanging(Moody):
    def receive(self, data: bytes, now: int) -> None:
        self.due(len(data))
        if self.left > 0:
            super().receive(data, now)


class Flooding(Moody):
    """A byte every 100 us, without end."""

    begun: int | None = None

    def receive(self, data: bytes, now: int) -> None:
        if self.due(len(data)):
            self.begun = now
        super().receive(data, now)

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

    deaf_until = 0

    def receive(self, data: bytes, now: int) -> None:
        if self.due(len(data)):
            self.robot.power_cycle(now)
            self.deaf_until = now + BOOT
        if now >= self.deaf_until:
            super().receive(data, now)


def run(protocol: Protocol, kind: Callable[[Protocol, int], Moody], after: int) -> Report:
    return conform(kind(protocol, after), grammar=protocol, options=SMOKE)


def counted(protocol: Protocol) -> int:
    """How many bytes the same run sends if nothing happens."""

    class Counting(Moody):
        def receive(self, data: bytes, now: int) -> None:
            self.due(len(data))
            super().receive(data, now)

    robot = Counting(protocol, 0)
    conform(robot, grammar=protocol, options=SMOKE)
    return -robot.left


def of(report: Report, verdict: Verdict) -> list[str]:
    return [result.id for result in report.results if result.verdict is verdict]


def test_one_that_hangs_fails_where_it_stopped_answering_and_the_rest_is_inconclusive(
    protocol: Protocol,
) -> None:
    whole = conform(Simulator(protocol), grammar=protocol, options=SMOKE)
    report = run(protocol, Hanging, counted(protocol) * 3 // 4)
    failed = of(report, Verdict.FAIL)

    assert report.exit == 1
    assert failed[1:] in ([], ["leave/stopped"])  # it may drive on, and that is said too
    at = [result.id for result in report.results].index(failed[0])
    after = [result for result in report.results[at + 1 :] if result.id != "leave/stopped"]
    assert {result.verdict for result in after} <= {Verdict.INCONCLUSIVE}
    assert of(report, Verdict.PASS)
    rest = next(r for r in report.results if r.verdict is Verdict.INCONCLUSIVE)
    assert "stopped answering" in rest.axes["answer"].reason
    ran = {result.id for result in whole.results}
    assert ran <= {result.id for result in report.results} | {"power-on/Forward"}


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


def served(protocol: Protocol, read: int, write: int, after: int) -> None:
    """The reference over descriptors, closed after so many bytes."""
    clock = 0
    robot = Moody(protocol, after)
    while robot.left > 0:
        ready = select.select([read], [], [], 0.02)[0]
        clock += MS if ready else 60 * MS
        if ready:
            data = os.read(read, 64)
            if not data:
                return
            robot.due(len(data))
            robot.receive(data, clock)
        os.write(write, robot.advance(clock))


def told(port: str, report: Path) -> tuple[int, str, dict[str, object]]:
    words = ("conform", port, "--yes", "--json", str(report), "--level", "smoke")
    result = process(*words)
    assert b"Traceback" not in result.stderr
    return result.returncode, result.stderr.decode(), msgspec.json.decode(report.read_bytes())


@pytest.mark.timeout(120)
def test_a_socket_that_closes_ends_the_run_in_2_with_what_was_judged_kept(
    protocol: Protocol, tmp_path: Path
) -> None:
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        peer, _ = listener.accept()
        with peer, suppress(OSError):
            served(protocol, peer.fileno(), peer.fileno(), 400)

    thread = threading.Thread(target=serve)
    thread.start()
    port = f"socket://127.0.0.1:{listener.getsockname()[1]}"
    code, said, report = told(port, tmp_path / "r.json")
    thread.join(PATIENCE)
    listener.close()
    assert_kept(code, said, report)


@pytest.mark.waits
@pytest.mark.timeout(120)
def test_a_pty_that_is_gone_ends_the_run_in_2_with_what_was_judged_kept(
    protocol: Protocol, tmp_path: Path
) -> None:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    port = os.ttyname(theirs)

    def serve() -> None:
        with suppress(OSError):
            served(protocol, ours, ours, 400)
        os.close(ours)

    thread = threading.Thread(target=serve)
    thread.start()
    code, said, report = told(port, tmp_path / "r.json")
    thread.join(PATIENCE)
    os.close(theirs)
    assert_kept(code, said, report)


def assert_kept(code: int, said: str, report: dict[str, object]) -> None:
    counts = report["counts"]
    assert isinstance(counts, dict)
    assert code == report["exit"] == 2
    assert counts["pass"] > 3
    assert counts["error"] == 1
    assert counts["fail"] == 0
    assert counts["inconclusive"] > 10
    cases = report["cases"]
    assert isinstance(cases, list)
    (error,) = [case for case in cases if case["verdict"] == "error"]
    reasons = [axis["reason"] for axis in error["axes"].values() if axis["reason"]]
    assert reasons
    assert "\n" not in reasons[0]
