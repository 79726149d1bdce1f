"""`conform --watch`: a device is tested again whenever it comes back or a file has changed."""

from __future__ import annotations

import signal
from contextlib import ExitStack
from pathlib import Path
from threading import Event

import pytest
from msgspec.structs import replace

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.replug import PathWatch
from bilprov.conformance.cli.last_run import LastRun, Run
from bilprov.conformance.cli.watch import Comeback, FileWatch, change_words
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import SIMAVR, TargetName
from bilprov.conformance.oracle.verdicts import Cause, Verdict
from bilprov.spec.protocol import Protocol
from tests.support.commands import Running, command, running
from tests.support.reports import a_case, a_run
from tests.support.robots import PATIENCE, plugged, simulate

FAULTY = ("--fault", "ok-to-bad-data")  # it stops, so that it is judged soon
LED = "bad-data/LED/8"
WAITING = "; Ctrl-C ends\n"


@pytest.fixture
def profile(tmp_path: Path) -> tuple[str, ...]:
    """The options of a short run of one case: what the simulator chooses is known already."""
    file = tmp_path / "profile.toml"
    command(
        "conform", "sim", "--level", "smoke", "--only", "bad-data/LED/*", "--profile", str(file)
    )
    known = ("--profile", str(file), "--truncation-timeout", "50")
    return ("--level", "smoke", "--only", "bad-data/LED/*", *known, "--yes")


def block(watching: Running) -> list[str]:
    """What is reported of the next run: its numbers, and the cases by what became of them."""
    lines = [""]
    while not lines[-1].startswith("run "):
        lines.append(watching.stdout.readline().decode())
        assert lines[-1], watching.stderr.read().decode()
    cases, _, _ = lines[-1].partition(";")
    count = cases.count(",") + 1 if "nothing" not in cases else 0
    lines += [watching.stdout.readline().decode() for _ in range(count)]
    return [" ".join(line.split()) for line in lines[-1 - count :]]


def until_it_waits(watching: Running) -> list[str]:
    """What is noted until it waits for the next run."""
    lines = [""]
    while not lines[-1].endswith(WAITING):
        lines.append(watching.stderr.readline().decode())
        assert lines[-1], lines
    return lines[1:]


@pytest.mark.waits
def test_a_device_behind_a_socket_is_tested_whenever_it_is_reachable_again(
    profile: tuple[str, ...],
) -> None:
    with ExitStack() as stack:
        with simulate(*FAULTY) as served:
            words = ("conform", served.port, "--probe", served.probe, *profile, "--watch")
            watching = stack.enter_context(running(*words))
            assert block(watching) == ["run 1: 1 new failure; causes: 1 new", f"new failures {LED}"]
            until_it_waits(watching)
        with simulate(like=served):
            assert block(watching) == ["run 2: 1 fixed; causes: 1 fixed", f"fixed {LED}"]
            assert f"{served.port} is there again\n" in until_it_waits(watching)
        with simulate(*FAULTY, like=served) as served:
            assert block(watching) == ["run 3: 1 new failure; causes: 1 new", f"new failures {LED}"]
            until_it_waits(watching)
            assert watching.end()[0] == 1
            assert served.state()["moving"] is False


class Moved(Simulator):
    """A robot that notes that it has been set in motion."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self.moved = Event()

    def receive(self, data: bytes, now: int) -> None:
        super().receive(data, now)
        if self.state.moving:
            self.moved.set()


@pytest.mark.waits
def test_a_port_that_is_unplugged_in_a_run_is_tested_again_and_ctrl_c_leaves_it_at_rest(
    tmp_path: Path, protocol: Protocol
) -> None:
    link, first, second = tmp_path / "robot", Moved(protocol), Moved(protocol)
    with ExitStack() as stack:
        with plugged(link, first):
            words = ("conform", str(link), "--level", "smoke", "--yes", "--watch")
            watching = stack.enter_context(running(*words))
            assert first.moved.wait(PATIENCE)
        assert block(watching) == ["run 1: nothing fails, ended early"]
        until_it_waits(watching)
        with plugged(link, second):
            assert watching.stderr.readline().decode() == f"{link} is there again\n"
            assert second.moved.wait(PATIENCE)
            code, out, _ = watching.end()

    assert code == 3
    assert out.endswith(b"run 2: nothing fails, ended early\n")
    assert not second.state.moving


@pytest.mark.sample(1)
@pytest.mark.waits
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_changed_file_begins_a_run_and_the_exit_code_is_the_last_ones(
    tmp_path: Path, how: signal.Signals
) -> None:
    stamp, report = tmp_path / "flashed", tmp_path / "report.json"
    words = ("--level", "smoke", "--only", "bad-data/LED/*", *FAULTY, "--json", str(report))
    with running("conform", "sim", *words, "--watch-file", str(stamp)) as watching:
        assert block(watching)[0] == "run 1: 1 new failure; causes: 1 new"
        assert until_it_waits(watching)[-1] == f"waiting for {stamp} to change; Ctrl-C ends\n"
        report.unlink()
        stamp.touch()
        assert block(watching)[0] == "run 2: 1 still failing; causes: 1 still there"
        assert f"{stamp} has changed\n" in until_it_waits(watching)
        assert report.exists()
        assert watching.end(how)[0] == 1


def test_of_an_emulated_board_the_firmware_is_watched(protocol: Protocol) -> None:
    board, settings = Path("car.elf"), line_settings(protocol)

    assert Comeback(TargetName("a board", SIMAVR, board), settings, None).words == (
        "car.elf to change"
    )


# -- what has come back, and what has changed -----------------------------------------------------


def test_a_file_has_changed_once_it_is_written_to_its_end(tmp_path: Path) -> None:
    file = tmp_path / "firmware.hex"
    watch = FileWatch(file)
    assert not watch.changed()
    file.write_bytes(b"a")
    assert not watch.changed()  # it may still be written
    file.write_bytes(b"ab")
    assert not watch.changed()
    assert watch.changed()
    assert not watch.changed()
    file.unlink()
    assert [watch.changed() for _ in range(3)] == [False] * 3
    file.write_bytes(b"abc")
    assert [watch.changed() for _ in range(3)] == [False, True, False]


def test_a_port_has_come_back_once_it_is_another_file(tmp_path: Path) -> None:
    port, kept = tmp_path / "port", tmp_path / "kept"
    port.touch()
    watch = PathWatch(str(port))
    assert not watch.returned()
    port.rename(kept)
    assert [watch.returned() for _ in range(2)] == [False, False]
    kept.rename(port)
    assert [watch.returned() for _ in range(2)] == [True, False]
    kept.touch()
    kept.replace(port)  # between two looks
    assert [watch.returned() for _ in range(2)] == [True, False]


def test_what_a_run_changed_is_said_in_words(protocol: Protocol) -> None:
    before = LastRun("sim", "robot-car", dict.fromkeys("abcdefg", "fail"))
    now = [(Verdict.PASS, "abcde"), (Verdict.FAIL, "fxy"), (Verdict.INCONCLUSIVE, "g")]
    results = tuple(replace(a_case("made", v), id=i) for v, idents in now for i in idents)
    report = replace(a_run(protocol, "valid/LED/1"), results=results)

    def words(before: LastRun) -> list[str]:
        return change_words(4, Run(before, report, before.after(report)))

    def cause(sentence: str, *cases: str) -> Cause:
        return Cause(sentence, "always", "answer", "section 3", cases, 0, ())

    before = replace(before, causes=(cause("a byte is off", *"ab"), cause("f is late", "f")))
    report = replace(report, causes=(cause("f is later", "f"), cause("x is lost", "x")))

    assert words(before) == [
        "run 4: 5 fixed, 1 still failing, 2 new failures, 1 not judged again; "
        "causes: 1 fixed, 1 still there, 1 new",
        "  fixed             a, b, c and 2 others",
        "  still failing     f",
        "  new failures      x, y",
        "  not judged again  g",
    ]
    none = LastRun("sim", "robot-car")
    assert words(none) == ["run 4: 3 new failures; causes: 2 new", "  new failures  f, x, y"]
