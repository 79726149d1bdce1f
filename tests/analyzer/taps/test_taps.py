"""Taps and bridge: bytes are recorded unchanged and in order, and neither side is delayed."""

from __future__ import annotations

import itertools
import os
import select
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.sources import (
    LATE,
    Bridge,
    HalfDuplexTap,
    SimulatedDrive,
    Source,
    Taps,
    counted,
    require_two_lines,
)
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.port import Forward, Port, PtyPair, open_port, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.protocol import Protocol
from tests.support.wires import master_gives, read_from

pytestmark = pytest.mark.waits

ALL = bytes(range(256))
Event = Chunk | Line


@pytest.fixture
def host_line() -> Iterator[PtyPair]:
    with open_pty() as pair:
        yield pair


@pytest.fixture
def device_line() -> Iterator[PtyPair]:
    with open_pty() as pair:
        yield pair


@pytest.fixture
def taps(host_line: PtyPair, device_line: PtyPair) -> Iterator[Taps]:
    with Taps(open_port(host_line.name), open_port(device_line.name)) as made:
        yield made


@pytest.fixture
def bridge(device_line: PtyPair) -> Iterator[Bridge]:
    with Bridge(open_port(device_line.name)) as made:
        yield made


@pytest.fixture
def host(bridge: Bridge) -> Iterator[Port]:
    with open_port(bridge.served) as made:
        yield made


def heard(events: list[Event], direction: str) -> bytes:
    return b"".join(
        event.data for event in events if isinstance(event, Chunk) and event.direction == direction
    )


def lines(events: list[Event]) -> list[Line]:
    return [event for event in events if isinstance(event, Line)]


def poll_until(source: Source, host: int = 0, device: int = 0) -> list[Event]:
    """Poll until so many bytes of each side were heard; the test's time limit ends it else."""
    events: list[Event] = []
    while len(heard(events, "host")) < host or len(heard(events, "device")) < device:
        events += source.poll(0.05)
    return events


def visible(port: Port) -> None:
    select.select([port], [], [])


# Taps


def test_taps_hear_every_byte_of_both_sides_and_never_write(
    taps: Taps, host_line: PtyPair, device_line: PtyPair
) -> None:
    host_line.write_some(ALL)
    device_line.write_some(ALL)
    events = poll_until(taps, 256, 256)
    assert heard(events, "host") == heard(events, "device") == ALL
    assert not lines(events)
    assert taps.heard == {"host", "device"}
    assert (taps.attached, taps.one_clock, taps.served) == (True, False, "")
    assert taps.names == {"host": host_line.name, "device": device_line.name}
    taps.close()
    assert host_line.read() == device_line.read() == b""


def test_one_tap_hears_both_directions_of_one_wire(host_line: PtyPair) -> None:
    asked = bytes.fromhex("f703408200026575")
    answer = bytes.fromhex("f70304000000032c3d")
    with HalfDuplexTap(open_port(host_line.name), load_protocol("modbus-rtu"), 10_000_000) as tap:
        host_line.write_some(asked + answer + asked[:5])
        events = poll_until(tap, len(asked), len(answer))
        events += tap.rest()
        host_line.write_some(asked[:5])
        events += poll_until(tap, 5)  # silence ends what is not whole

        assert heard(events, "host") == asked + asked[:5] * 2
        assert heard(events, "device") == answer


def test_when_both_sides_are_readable_the_host_comes_first(
    host_line: PtyPair, device_line: PtyPair
) -> None:
    host_port, device_port = open_port(host_line.name), open_port(device_line.name)
    with Taps(host_port, device_port) as taps:
        device_line.write_some(b"\x00")
        visible(device_port)
        host_line.write_some(b"\x10")
        visible(host_port)
        events = taps.poll(None)
        assert [event.direction for event in events if isinstance(event, Chunk)] == [
            "host",
            "device",
        ]


def test_times_never_go_back_and_start_at_the_source(
    taps: Taps, host_line: PtyPair, device_line: PtyPair
) -> None:
    events: list[Event] = []
    for _ in range(50):
        host_line.write_some(b"\x10")
        device_line.write_some(b"\x00")
        events += taps.poll(None)
    events += taps.poll(0)
    times = [0, *(event.t for event in events), taps.now()]
    assert all(before <= after for before, after in itertools.pairwise(times))
    assert taps.start_wall > 0


def test_a_reader_that_comes_too_late_notes_since_when_nothing_was_read(
    taps: Taps, host_line: PtyPair
) -> None:
    host_line.write_some(b"\x10")
    (*_, before) = taps.poll(1)
    host_line.write_some(b"\x20")
    time.sleep(LATE / 1e9 + 0.1)
    waited, after = taps.poll(0.05)

    assert isinstance(waited, Line)
    assert (waited.event, waited.t) == ("waited", before.t)
    assert isinstance(after, Chunk)
    assert taps.seen == after.t


def test_a_simulated_drive_misses_nothing_where_the_program_is_late(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = SimulatedDrive(protocol, line_settings(protocol))
    monkeypatch.setattr(drive, "_start", drive._start - 5_000 * MS)
    assert not lines(drive.poll(0.05))


def test_a_poll_with_nothing_to_hear_ends(taps: Taps) -> None:
    assert taps.poll(0) == []
    with Stopper() as stopper:
        stopper.stop()
        assert taps.poll(None, [stopper.fileno()]) == []
    assert not taps.ended


def test_an_unplugged_tap_is_said_once_and_the_other_is_heard_on(
    taps: Taps, host_line: PtyPair, device_line: PtyPair
) -> None:
    device_line.close()
    (gone,) = taps.poll(None)
    assert isinstance(gone, Line)
    assert (gone.event, gone.tap) == ("unplugged", "device")
    assert gone.detail.startswith(f"{device_line.name} disappeared")
    assert not taps.ended
    host_line.write_some(b"\x10")
    assert heard(poll_until(taps, 1), "host") == b"\x10"
    host_line.close()
    assert [event.event for event in lines(taps.poll(None))] == ["unplugged"]
    assert taps.ended
    assert taps.poll(None) == []


def test_two_taps_on_one_line_are_refused(host_line: PtyPair, tmp_path: Path) -> None:
    link = tmp_path / "tap"
    link.symlink_to(host_line.name)
    with pytest.raises(ValueError, match="a tap hears one direction, so give two"):
        require_two_lines(host_line.name, str(link))
    require_two_lines("socket://127.0.0.1:1", "socket://127.0.0.1:2")


def test_what_the_driver_counts_becomes_line_events() -> None:
    before = {"parity": 1, "framing": 0, "overrun": 5, "break": 0}
    after = {"parity": 3, "framing": 0, "overrun": 5, "break": 1}
    assert list(counted(7, "host", before, after)) == [
        Line(7, "parity", "host", "2 counted by the driver"),
        Line(7, "break", "host", "1 counted by the driver"),
    ]
    assert list(counted(7, "host", after, before)) == []  # counters that start anew


# Many reads at once


class Script(Source):
    """A source without ports: what comes when (ns), on a clock that stands still in between.

    At the time `stopped` the program stops for twice `LATE`.
    """

    def __init__(self, *reads: tuple[int, bytes], stopped: int = 0) -> None:
        super().__init__({})
        self._ports = {"host": Mock(**{"error_counts.return_value": None})}
        self._reads = list(reads)
        self._stopped = stopped
        self._now = 0

    def now(self) -> int:
        return self._now

    def _gather(self, events: list[Event], timeout_s: float | None, also: Sequence[int]) -> None:
        end = self._now + round((timeout_s or 0) * 1e9)
        if not self._reads or self._reads[0][0] > end:
            self._now = end
            return
        t, data = self._reads.pop(0)
        self._now = max(self._now, t) + (2 * LATE if t == self._stopped else 0)
        events.append(self._chunk("host", data))


def polled(source: Source, polls: int) -> list[list[int]]:
    """The times (ms) of what each poll returns."""
    return [[event.t // MS for event in source.poll(1)] for _ in range(polls)]


def test_on_a_busy_line_many_reads_are_returned_at_once_each_with_its_time() -> None:
    source = Script(*((at * MS, bytes(12)) for at in range(1, 111)))

    assert polled(source, 29) == [[at] for at in range(1, 30)]
    assert polled(source, 3) == [list(range(30, 61)), list(range(61, 92)), list(range(92, 111))]


def test_what_comes_slowly_or_after_a_pause_is_returned_at_once() -> None:
    slow = Script(*((at * MS, b"\x10\x20") for at in range(1, 76)))
    assert polled(slow, 75) == [[at] for at in range(1, 76)]

    busy = [(at * MS, bytes(12)) for at in range(1, 111)]
    paused = Script(*busy, (500 * MS, b"\x10"), (501 * MS, b"\x10"))
    assert polled(paused, 34)[-2:] == [[500], [501]]


def test_a_stop_among_reads_that_are_returned_at_once_is_noted_where_it_was() -> None:
    source = Script(*((at * MS, bytes(12)) for at in range(1, 76)), stopped=65 * MS)
    polled(source, 30)

    *before, waited, after = source.poll(1)
    assert [event.t // MS for event in before] == [61, 62, 63, 64]
    assert isinstance(waited, Line)
    assert (waited.event, waited.t) == ("waited", 64 * MS)
    assert after.t == 65 * MS + 2 * LATE


# Handing on

SECOND = 1_000_000_000


class Peer:
    """Takes `room` bytes at most, then nothing until it gets more room."""

    def __init__(self) -> None:
        self.room = 0
        self.got = b""

    def write_some(self, data: bytes) -> int:
        taken = data[: self.room]
        self.room -= len(taken)
        self.got += taken
        return len(taken)


def test_bytes_wait_for_a_slow_peer_and_pass_in_order() -> None:
    peer = Peer()
    forward = Forward(peer.write_some, "it does not read")
    for step in range(256):
        assert not forward.push(bytes([step]), step * SECOND)
        peer.room += 1
    assert not forward.push(b"", 256 * SECOND)
    assert not forward.owed
    assert peer.got == ALL


def test_a_peer_that_takes_nothing_for_a_second_gets_nothing_old() -> None:
    peer = Peer()
    forward = Forward(peer.write_some, "it does not read")
    assert not forward.push(b"old", 5 * SECOND)
    assert not forward.push(b"", 6 * SECOND - 1)
    assert forward.push(b"", 6 * SECOND) == "it does not read; 3 bytes or more were not handed on"
    assert not forward.push(b"old", 7 * SECOND)  # said once
    assert not forward.owed
    peer.room = 100
    assert not forward.push(b"new", 8 * SECOND)
    assert peer.got == b"new"
    peer.room = 0
    assert not forward.push(b"old", 9 * SECOND)
    assert forward.push(b"", 10 * SECOND)  # and again, since it had read in between


def test_what_waits_is_bounded() -> None:
    peer = Peer()
    forward = Forward(peer.write_some, "it does not read")
    assert forward.push(bytes(70_000), 0) == (
        "it does not read; 4464 bytes or more were not handed on"
    )
    peer.room = 100_000
    assert not forward.push(b"", 1)
    assert peer.got == bytes(65_536)


def test_a_peer_that_has_gone_is_said_with_its_own_sentence() -> None:
    def gone(data: bytes) -> int:
        raise LinkError("it disappeared")

    assert Forward(gone, "it does not read").push(b"x", 0).startswith("it disappeared; 1 bytes")


# Bridge


def test_a_bridge_passes_and_records_every_byte_both_ways(
    bridge: Bridge, host: Port, device_line: PtyPair
) -> None:
    assert (bridge.attached, bridge.one_clock) == (False, True)
    host.write(ALL)
    assert heard(poll_until(bridge, host=256), "host") == ALL
    assert master_gives(device_line, 256) == ALL
    device_line.write_some(ALL)
    assert heard(poll_until(bridge, device=256), "device") == ALL
    assert read_from(host, 256) == ALL


def test_host_programs_may_come_and_go(bridge: Bridge, device_line: PtyPair) -> None:
    for byte in (b"\x10", b"\x90"):
        with open_port(bridge.served) as host:
            host.write(byte)
            assert heard(poll_until(bridge, host=1), "host") == byte
    assert not bridge.ended


def test_a_host_that_does_not_read_loses_bytes_but_the_recording_does_not(
    bridge: Bridge, host: Port, device_line: PtyPair
) -> None:
    sent = os.urandom(1 << 20)

    def flood() -> None:
        left = memoryview(sent)
        while left:
            select.select([], [device_line.master], [])
            left = left[device_line.write_some(bytes(left[:4096])) :]

    thread = threading.Thread(target=flood)
    thread.start()
    events = poll_until(bridge, device=len(sent))
    thread.join()
    assert heard(events, "device") == sent
    (gap,) = lines(events)
    assert (gap.event, gap.tap) == ("gap", "device")
    assert gap.detail.startswith("the host program does not read; ")
    # What waits for it is bounded, and the host's own bytes still pass.
    host.write(b"\x10")
    assert heard(poll_until(bridge, host=1), "host") == b"\x10"


def test_a_device_that_floods_is_given_on_in_small_parts(
    bridge: Bridge, device_line: PtyPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes at once is decoded at once, so it must not fill the memory."""
    much = bytes(1 << 14)
    monkeypatch.setattr(Port, "read", lambda port, ready: much)
    device_line.write_some(b"\0")  # never read, so that there is always more

    assert heard(bridge.poll(1), "device") == much


def test_a_device_that_does_not_read_loses_bytes_but_the_recording_does_not(
    bridge: Bridge, host: Port
) -> None:
    sent = os.urandom(1 << 18)
    thread = threading.Thread(target=host.write, args=(sent,))
    thread.start()
    events = poll_until(bridge, host=len(sent))
    thread.join()
    assert heard(events, "host") == sent
    (gap,) = lines(events)
    assert (gap.event, gap.tap) == ("gap", "host")
    assert gap.detail.startswith("the device does not read; ")


def test_a_bridge_ends_with_its_device(bridge: Bridge, device_line: PtyPair) -> None:
    device_line.close()
    (gone,) = bridge.poll(None)
    assert isinstance(gone, Line)
    assert (gone.event, gone.tap) == ("unplugged", "device")
    assert bridge.ended
    assert bridge.poll(None) == []


def test_a_host_that_opens_a_bridge_without_its_device_does_not_keep_it_busy(
    device_line: PtyPair, tmp_path: Path
) -> None:
    (tmp_path / "port").symlink_to(device_line.name)
    with Bridge(open_port(str(tmp_path / "port"))) as bridge:
        device_line.close()
        bridge.poll(None)
        with open_port(bridge.served):
            bridge.poll(0.1)
            begun = time.monotonic()
            assert bridge.poll(0.1) == []

    assert time.monotonic() - begun >= 0.1


def test_closing_a_source_closes_its_ports(bridge: Bridge, device_line: PtyPair) -> None:
    bridge.close()
    bridge.close()
    with open_port(device_line.name):
        pass
    with pytest.raises(LinkError, match="there is no"):
        open_port(bridge.served)


def test_one_tap_alone_hears_the_host(host_line: PtyPair) -> None:
    with Taps(open_port(host_line.name), None) as alone:
        assert alone.heard == {"host"}
        host_line.write_some(ALL)
        assert heard(poll_until(alone, 256), "host") == ALL
