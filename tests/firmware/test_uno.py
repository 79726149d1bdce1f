"""The reference firmware on an emulated Arduino Uno: the kit tests a device that is not its own."""

from __future__ import annotations

import ctypes
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.boards import EmulatorError, libsimavr
from bilprov.conformance.dut.boards import simavr as uno
from bilprov.conformance.dut.boards.firmware import read_firmware
from bilprov.conformance.dut.boards.libsimavr import Avr
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State
from tests.support.car import car_state, wheels
from tests.support.commands import command
from tests.support.firmware import AVR, BUGS, Bench, built
from tests.support.robots import sentence
from tests.vectors import FRAMES

pytestmark = AVR

PAUSE = 70 * MS  # ends a frame that lacks data


class Uno(Bench):
    """The reference firmware on its board."""

    def __init__(self, switches: str = "") -> None:
        super().__init__(built(switches))

    def direction(self) -> bool:
        """Whether a direction pin (D7 to D10) is high: what the README's probe is soldered to."""
        return bool(self.board.memory(0x2B) & 0x80 or self.board.memory(0x25) & 0x07)

    def home(self) -> None:
        """Between two frames, stopped."""
        self.send(bytes(16), wait=PAUSE, answers=None)

    def drive(self, speed: int = 0xFF) -> None:
        """Between two frames, at this speed."""
        self.home()
        assert self.send(bytes([0x11, speed])) + self.send(b"\x20") == b"\x00\x00"


@pytest.fixture(scope="module")
def bench() -> Uno:
    return Uno()


def test_it_is_at_rest_after_power_on_and_knows_nothing_of_before() -> None:
    bench = Uno()
    for _ in range(2):
        assert (bench.look().motion, bench.look().led) == ("stopped", 0)
        assert bench.send(b"\x20") == b"\x00"
        assert bench.look().moving is False  # it has no speed
        for frame in (b"\x11\xff", b"\x81\x05"):
            assert bench.send(frame) == b"\x00"
        assert (bench.look().moving, bench.look().led) == (True, 5)
        bench.board.power_cycle(bench.board.deadline())


@pytest.mark.parametrize("vector", FRAMES, ids=lambda vector: vector.frame.hex())
def test_it_answers_the_frames_of_the_document(bench: Uno, vector: object) -> None:
    bench.home()

    assert bench.send(vector.frame, wait=PAUSE) == bytes([vector.code])  # type: ignore[attr-defined]


def agrees(look: Look, state: State, full: int) -> bool:
    """Whether the pins show the state: the wheels' signs, which is faster, and the diode."""
    left, right = wheels(state, full)
    assert look.left is not None
    assert look.right is not None

    def order(one: int, other: int) -> tuple[int, int, int]:
        return (one > 0) - (one < 0), (other > 0) - (other < 0), (one > other) - (one < other)

    return order(look.left, look.right) == order(left, right) and look.led == state.led


@pytest.mark.slow
@given(st.data())
@settings(max_examples=100)
def test_its_pins_follow_the_motion_model(
    bench: Uno, protocol: Protocol, data: st.DataObject
) -> None:
    lengths = protocol.lengths
    good = [protocol.header_bytes[spec.id, spec.length] for spec in protocol.instructions]
    header = st.one_of(st.sampled_from(good), st.integers(0, 255))
    frames = data.draw(
        st.lists(
            header.flatmap(
                lambda h: st.binary(min_size=lengths[h], max_size=lengths[h]).map(
                    lambda rest: bytes([h]) + rest
                )
            ),
            max_size=12,
        )
    )
    bench.home()
    bench.send(b"\x11\x00")
    bench.send(b"\x81\x00")
    state = car_state(speed=0)
    _, full = protocol.limits["steering"]
    for frame in frames:
        judgement = judge(protocol, frame)
        assert bench.send(frame) == bytes([judgement.response.code])
        effect = judgement.instruction.effect if judgement.valid and judgement.instruction else None
        state = (effect or protocol.on_fault).apply(state, dict(judgement.fields))
        assert agrees(bench.look(), state, full), (frame.hex(), state, bench.look())
        assert bench.direction() == bench.look().moving


@pytest.mark.parametrize("frame", ["90", "10", "4200", "81 08", "e3"])
def test_it_stands_still_within_a_millisecond_of_the_byte_that_makes_it_faulty(
    bench: Uno, frame: str
) -> None:
    bench.drive()
    assert bench.look().moving

    bench.send(bytes.fromhex(frame), wait=MS)

    assert bench.look().moving is False


def test_a_header_without_its_data_stops_it_when_its_time_is_over(bench: Uno) -> None:
    bench.drive()

    assert bench.send(b"\x81", wait=48 * MS) == b""
    assert bench.look().moving
    # 50 ms by a clock of one millisecond, whose phase is unknown here, and the answer's own byte.
    assert bench.send(b"", wait=4 * MS, answers=None) == b"\x04"
    assert bench.look().moving is False


def test_a_damaged_byte_between_two_frames_stops_it_and_is_not_answered(bench: Uno) -> None:
    bench.drive(0x20)

    bench.board.spoil(0x11, bench.board.deadline())

    assert bench.send(b"\x20", wait=PAUSE, answers=None) == b""  # the data of that header
    assert bench.look().moving is False
    assert bench.send(b"\x90") == b"\x01"


def test_answers_to_what_came_before_a_damaged_byte_are_not_lost(bench: Uno) -> None:
    bench.home()
    sent = bench.board.deadline()
    for byte in b"\x90\x10\x00":
        bench.board.receive(bytes([byte]), sent)
    bench.board.spoil(0x20, sent)

    assert bench.send(b"", wait=PAUSE, answers=None) == b"\x01\x04\x00"


def test_the_emulator_stops_where_it_is_told_also_while_the_chip_sleeps() -> None:
    avr, draw = (
        Avr(read_firmware(built(), uno.FLASH).code, uno.CHIP, uno.FREQUENCY, print),
        Random(1),
    )
    late = set()
    for turn in range(2000):
        cycle = avr.cycle + draw.randrange(1, 40_000)
        avr.run_until(cycle)
        late.add(avr.cycle - cycle)
        if turn % 10 == 0:
            avr.receive(draw.randrange(256))
    avr.close()

    assert min(late) >= 0
    assert max(late) <= 8  # cycles: an instruction, or the way into an interrupt


def test_a_loop_that_hangs_is_ended_by_the_watchdog_and_the_robot_stands_still() -> None:
    bench = Uno("-DBUG_HANGS_AT_FULL_SPEED")
    bench.home()
    for frame in (b"\x81\x07", b"\x11\x80", b"\x20"):
        assert bench.send(frame) == b"\x00"
    assert bench.send(b"\x11\xff", wait=100 * MS) == b""
    assert bench.look().moving

    bench.send(b"", wait=30 * MS)

    assert (bench.look().moving, bench.look().led) == (False, 0)
    assert bench.send(b"\x20") == b"\x00"
    assert bench.look().moving is False  # no speed was told since


# -- the suite ------------------------------------------------------------------------------------


def run(switches: str = "", **options: Any) -> Report:
    """What the suite says of the firmware, built with these switches."""
    return conform(SimavrBoard(built(switches)), options=Options(**options), name="uno")


@pytest.mark.slow
def test_the_suite_passes_the_clean_build_the_same_to_the_last_nanosecond(
    pytestconfig: pytest.Config,
) -> None:
    level = "standard" if pytestconfig.getoption("--whole") else "smoke"
    report, again = run(level=level), run(level=level)

    assert report.exit == 0
    assert {result.verdict for result in report.results} == {Verdict.PASS}
    for one, other in zip(report.results, again.results, strict=True):
        assert (one.id, one.received) == (other.id, other.received)


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_the_suite_finds_every_planted_bug(bug: str) -> None:
    report = run(f"-D{bug}", level="standard", fail_fast=True)

    assert report.exit == 1, report.counts


# -- boards of the command line ---


@pytest.mark.waits
def test_a_board_under_simavr_conforms_asks_nobody_and_brings_its_probe(tmp_path: Path) -> None:
    target = f"emulator:simavr:{built()}"
    record = tmp_path / "run.mcap"
    result = command(
        *("conform", target, "--level", "smoke", "--json", "-", "--record", str(record))
    )

    report = msgspec.json.decode(result.stdout)
    assert result.returncode == report["exit"] == 0, result.stderr
    assert report["device"] == target
    assert report["counts"]["pass"] == len(report["cases"])  # the power switch is there too
    assert command("recheck", str(record)).returncode == 0


@pytest.mark.waits
def test_firmware_that_crashes_is_a_silent_board_and_told(tmp_path: Path) -> None:
    file = tmp_path / "empty.elf"  # its headers, and no instruction but "do nothing"
    file.write_bytes(built().read_bytes()[:148].ljust(1 << 16, b"\0"))

    result = command("conform", f"emulator:simavr:{file}", "--level", "smoke")

    assert result.returncode == 2
    assert f"{file} crashed" in sentence(result)
    assert b"nobody answered" in result.stdout


@pytest.mark.waits
def test_another_version_of_the_emulator_is_told_and_not_guessed_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Other(ctypes.Structure):
        _fields_ = (("new", ctypes.c_uint64), *libsimavr._Avr._fields_)

    monkeypatch.setattr(libsimavr, "_Avr", Other)
    with pytest.raises(EmulatorError, match="is not laid out as version"):
        SimavrBoard(built())
