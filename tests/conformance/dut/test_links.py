"""Both links carry out the runner's operations: exactly in virtual time, without loss on a port."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from bilprov.analyzer.client import port_link
from bilprov.analyzer.client.operations import (
    Ended,
    Listen,
    Observation,
    Observe,
    Operation,
    Procedure,
    Received,
    Reconnected,
    Send,
    drive,
    send,
)
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.probes import Probe, open_probe
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.port import PtyPair, open_port, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.dut.simulator import Fault, Simulator, answers
from bilprov.conformance.dut.target import DeviceError, VirtualLink
from bilprov.spec.protocol import Protocol
from tests.support.robots import BYTE_TIME, PATIENCE, ProbeServer, served_here

pytestmark = pytest.mark.waits

LONG = int(PATIENCE * 1e9)  # ns; a link that waits so long hangs


class Noted:
    """A tap that notes what it hears."""

    def __init__(self) -> None:
        self.notes: list[tuple[str, object, int]] = []

    def sent(self, data: bytes, t: int) -> None:
        self.notes.append(("sent", data, t))

    def received(self, data: bytes, t: int) -> None:
        self.notes.append(("received", data, t))

    def looked(self, look: Look) -> None:
        self.notes.append(("looked", look.moving, look.t))


def heard_of(link: VirtualLink | PortLink, count: int | None, patience: int) -> Received:
    heard = link.do(Listen(count, patience))
    assert isinstance(heard, Received)
    return heard


# -- virtual time ---------------------------------------------------------------------------------


def test_bytes_take_their_time_on_the_wire(protocol: Protocol) -> None:
    link = VirtualLink(Simulator(protocol), BYTE_TIME)

    assert link.do(Send(bytes(3))) == 3 * BYTE_TIME
    heard = heard_of(link, 3, LONG)
    assert heard.answers == tuple(((i + 1) * BYTE_TIME, 0) for i in range(3))
    assert heard.now == 3 * BYTE_TIME


def test_listening_for_ever_ends_with_the_patience(protocol: Protocol) -> None:
    link = VirtualLink(Simulator(protocol), BYTE_TIME)

    assert heard_of(link, None, 7 * MS) == Received((), 7 * MS)
    assert heard_of(link, 1, 7 * MS) == Received((), 14 * MS)


def test_a_time_out_happens_at_its_own_time_in_the_middle_of_a_wait(protocol: Protocol) -> None:
    link = VirtualLink(Simulator(protocol), BYTE_TIME)
    link.do(Send(b"\x11"))

    heard = heard_of(link, None, 1000 * MS)

    assert heard.answers == ((BYTE_TIME + 50 * MS, 4),)
    assert heard.now == BYTE_TIME + 1000 * MS


def test_a_look_shows_the_robot_as_it_is_then(protocol: Protocol) -> None:
    coasting = Fault("x", "test", "", react=lambda d, e, r: (
        r if e.judgement.valid else replace(r, state=e.before, later=((9 * MS, r.state),))
    ))  # fmt: skip
    link = VirtualLink(Simulator(protocol, coasting), BYTE_TIME)
    link.do(Send(bytes.fromhex("11 c8 20 90")))

    before = link.do(Observe())
    heard_of(link, None, 9 * MS)
    after = link.do(Observe())

    assert isinstance(before, Observation)
    assert isinstance(after, Observation)
    assert (before.look.moving, after.look.moving) == (True, False)
    assert before.asked == before.now == before.look.t == 4 * BYTE_TIME


def test_a_device_whose_deadline_does_not_advance_is_wrong_use(protocol: Protocol) -> None:
    class Stuck(Simulator):
        def deadline(self) -> int | None:
            return 0

    link = VirtualLink(Stuck(protocol), BYTE_TIME)

    with pytest.raises(DeviceError, match=r"the device's deadline gave 0 again after advance\(0\)"):
        link.do(Listen(None, MS))


# -- scripts --------------------------------------------------------------------------------------


class Echo:
    """A link that answers every ask with the ask's number."""

    def __init__(self) -> None:
        self.asks: list[Operation] = []

    def do(self, ask: Operation) -> int | Received | Observation:
        self.asks.append(ask)
        return len(self.asks)


def talk(times: int) -> Procedure[list[int | str]]:
    got: list[int | str] = []
    for _ in range(times):
        try:
            got.append((yield from send(b"x")))
        except Ended as ended:
            got.append(str(ended))
    return got


def test_an_interrupt_is_told_once_and_before_the_next_ask_is_done() -> None:
    link, asked = Echo(), iter([False, False, True, True])

    assert drive(talk(4), link, lambda: next(asked)) == [1, "interrupted", 2, 3]
    assert len(link.asks) == 3


def test_what_an_interrupted_operation_brought_is_not_judged() -> None:
    link = Echo()

    assert drive(talk(3), link, lambda: len(link.asks) == 2) == [1, "interrupted", 3]


# -- ports ----------------------------------------------------------------------------------------


class Room:
    """A served simulator with a port link to it, and its own probe or one of that name."""

    def __init__(self, stack: ExitStack, device: Simulator, *, pty: bool, probe: str = "") -> None:
        name, own = stack.enter_context(served_here(device, pty=pty))
        self.device = device
        self.stopper = stack.enter_context(Stopper())
        self.port = stack.enter_context(open_port(name))
        self.probe = open_probe(probe or own, self.port, device.protocol)
        assert self.probe is not None
        stack.callback(self.probe.close)
        self.tap = Noted()
        self.link = PortLink(self.port, self.probe, self.stopper, self.tap)


@pytest.fixture(params=["tcp", "pty"])
def room(request: pytest.FixtureRequest, protocol: Protocol) -> Iterator[Room]:
    with ExitStack() as stack:
        yield Room(stack, Simulator(protocol), pty=request.param == "pty")


def test_a_port_answers_like_the_device_in_virtual_time(room: Room) -> None:
    sent = room.link.do(Send(bytes.fromhex("11 c8 20 90 81 08 00")))

    heard = heard_of(room.link, 5, LONG)

    assert heard.codes == (0, 0, 1, 2, 0)
    assert isinstance(sent, int)
    times = [t for t, _ in heard.answers]
    assert times == sorted(times)
    assert heard.now >= times[-1]


@pytest.mark.parametrize("byte", [0x00, 0x03, 0x04, 0x11, 0x13, 0x1A, 0x7F, 0xFF])
def test_no_byte_is_special_to_the_line(room: Room, byte: int) -> None:
    room.link.do(Send(bytes([0x11, byte])))

    assert heard_of(room.link, 1, LONG).codes == (0,)
    assert room.device.state.speed == byte


def test_a_look_on_a_port_tells_what_the_probe_tells(room: Room) -> None:
    room.link.do(Send(bytes.fromhex("81 05 11 c8 30")))
    heard_of(room.link, 3, LONG)

    seen = room.link.do(Observe())

    assert isinstance(seen, Observation)
    assert (seen.look.moving, seen.look.motion, seen.look.led) == (True, "backward", 5)
    assert (seen.look.left, seen.look.right) == (-200, -200)
    assert seen.asked <= seen.look.t <= seen.now


def test_the_port_goes_on_being_read_while_the_probe_is_asked(protocol: Protocol) -> None:
    slow = Fault("x", "test", "", react=lambda d, e, r: answers(r, 0, delay=20 * MS))
    device = Simulator(protocol, slow)
    with ExitStack() as stack:
        server = stack.enter_context(ProbeServer(b'{"moving": false}\n'))
        room = Room(stack, device, pty=False, probe=server.name)
        room.link.do(Send(b"\x20"))
        while ("received", b"\0") not in [note[:2] for note in room.tap.notes]:
            room.link.do(Observe())
        assert heard_of(room.link, None, 0).codes == (0,)

    assert server.requests
    assert set(server.requests) == {b"state\n"}


def test_a_stop_ends_the_waiting_once_and_then_waits_again_to_home(room: Room) -> None:
    room.stopper.stop()

    assert heard_of(room.link, 1, LONG).answers == ()
    room.link.do(Send(b"\0"))
    assert heard_of(room.link, 1, LONG).codes == (0,)


class Replies(Probe):
    """A probe whose replies come when the test says so; each is 0 or 1, whether it moves."""

    def __init__(self) -> None:
        self.ends = os.pipe()
        self.asked = threading.Event()

    def ask(self) -> None:
        self.asked.set()

    def fileno(self) -> int:
        return self.ends[0]

    def take(self, now: int) -> Look:
        return CarLook(now, os.read(self.ends[0], 1) == b"1")

    def reply(self, moving: bytes) -> None:
        os.write(self.ends[1], moving)

    def close(self) -> None:
        for end in self.ends:
            os.close(end)


@contextmanager
def unplugged(
    tmp_path: Path, protocol: Protocol, seconds: float
) -> Iterator[tuple[PortLink, Replies, PtyPair, Stopper]]:
    """A link to a port that can be unplugged: a name that leads to a pty."""
    settings, name = line_settings(protocol, None, None, None), tmp_path / "port"
    with ExitStack() as stack:
        pair = stack.enter_context(open_pty())
        name.symlink_to(pair.name)
        port = stack.enter_context(open_port(str(name), settings))
        stopper, probe = stack.enter_context(Stopper()), Replies()
        stack.callback(probe.close)
        yield PortLink(port, probe, stopper, reconnect=seconds), probe, pair, stopper


def test_the_reply_to_a_look_that_an_unplug_cut_short_is_waited_for_once(
    tmp_path: Path, protocol: Protocol
) -> None:
    with ExitStack() as stack:
        lines = [stack.enter_context(open_pty()) for _ in range(2)]
        link, probe, first, _ = stack.enter_context(unplugged(tmp_path, protocol, PATIENCE))

        def replug(old: PtyPair, new: PtyPair) -> None:
            old.close()
            (tmp_path / "new").symlink_to(new.name)
            (tmp_path / "new").replace(tmp_path / "port")

        def cut_short() -> None:
            probe.asked.wait(PATIENCE)
            replug(first, lines[0])
            probe.reply(b"1")

        away = threading.Thread(target=cut_short)
        away.start()
        with pytest.raises(Reconnected):
            link.do(Observe())
        away.join()
        replug(lines[0], lines[1])
        with pytest.raises(Reconnected):
            heard_of(link, 1, LONG)
        probe.reply(b"0")
        seen = link.do(Observe())

    assert isinstance(seen, Observation)
    assert seen.look.moving is False  # as of its own reply, not that of the look before


def test_a_run_that_was_stopped_does_not_wait_long_for_its_port(
    tmp_path: Path, protocol: Protocol, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_link, "_PARTING", 0.1)
    with unplugged(tmp_path, protocol, 86_400) as (link, _, pair, stopper):
        stopper.stop()
        assert heard_of(link, 1, LONG).answers == ()
        pair.close()

        with pytest.raises(Ended, match=r"not there again in 0\.1 s") as ended:
            heard_of(link, 1, LONG)

    assert not isinstance(ended.value, Reconnected)


def test_a_flood_does_not_fill_the_memory(protocol: Protocol) -> None:
    flooding = Fault("x", "test", "", react=lambda d, e, r: replace(r, answers=((0, 7),) * 60_000))
    with ExitStack() as stack:
        room = Room(stack, Simulator(protocol, flooding), pty=False)
        heard = 0
        for _ in range(4):
            room.link.do(Send(b"\0"))
            heard += len(heard_of(room.link, 60_000, 300 * MS).answers)
            assert heard <= 4 << 16
