"""Limits of the server: a client that floods, does not read or comes in crowds delays nobody."""

from __future__ import annotations

import json
import os
import resource
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest

from bilprov.analyzer.transport.server import PROBE_LIMIT, REQUEST_LIMIT, UNREAD_LIMIT, Server
from bilprov.analyzer.transport.signals import Stopper
from bilprov.analyzer.transport.streams import NO_DESCRIPTOR, Listener, parse_address
from tests.support.commands import PATIENCE
from tests.support.robots import simulate
from tests.support.wires import Running, running

SECOND = 1_000_000_000  # ns
GRACE = 20_000_000  # ns that a turn waits for bytes that the system still has under way


class Recorder:
    """A device that notes in `events` what reaches it; its answer to a look is `size` bytes."""

    def __init__(self, size: int = 0) -> None:
        self.events: list[str] = []
        self.bytes = 0
        self.size = size

    def receive(self, data: bytes, now: int) -> None:
        self.events.append("receive")
        self.bytes += len(data)

    def advance(self, now: int) -> bytes:
        return b""

    def deadline(self) -> int | None:
        return GRACE

    def probe(self, now: int) -> bytes:
        self.events.append("look")
        return json.dumps({"moving": False, "filler": "x" * self.size}).encode()


class Patient(Recorder):
    """One that needs no turn unless bytes come."""

    def deadline(self) -> int | None:
        return None


class Room:
    """A server that a test drives turn by turn; its clock is `now`."""

    def __init__(self, device: Recorder, stack: ExitStack) -> None:
        self.now = 0
        self.notes: list[str] = []
        self.stopper = stack.enter_context(Stopper())
        self.server = Server(device, lambda: self.now, self.stopper, self.notes.append)
        stack.callback(self.server.close)
        self.server.listener = stack.enter_context(Listener("127.0.0.1:0"))
        self.server.probe_listener = stack.enter_context(Listener("127.0.0.1:0"))
        self._stack = stack

    def turns(self, count: int) -> None:
        for _ in range(count):
            assert self.server.turn()

    def host(self) -> socket.socket:
        client = self._connected(self.server.listener)
        self.turns(1)
        return client

    def probe(self, buffer: int = 0) -> socket.socket:
        client = self.connecting(buffer)
        self.turns(1)
        return client

    def connecting(self, buffer: int = 0) -> socket.socket:
        """A client of the probe that the server has not accepted yet."""
        return self._connected(self.server.probe_listener, buffer)

    def _connected(self, listener: Listener | None, buffer: int = 0) -> socket.socket:
        """Connect; the system keeps some `buffer` bytes for the client, where it is not 0."""
        assert listener is not None
        client = self._stack.enter_context(socket.socket())
        client.settimeout(PATIENCE)
        if buffer:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        client.connect(parse_address(listener.address))
        return client


Start = Callable[[Recorder], Room]


@pytest.fixture
def start() -> Iterator[Start]:
    with ExitStack() as stack:
        yield lambda device: Room(device, stack)


def heard(client: socket.socket) -> bytes:
    """What has come so far; the server has sent it, and the system may have it under way."""
    client.settimeout(GRACE / SECOND)
    data = b""
    try:
        while more := client.recv(1 << 16):
            data += more
            client.setblocking(False)
    except (BlockingIOError, TimeoutError):
        return data
    return data + b"(closed)"


def error_of(line: bytes) -> str:
    error = json.loads(line)["error"]
    assert isinstance(error, str)
    return error


# how many, and how long


def test_every_probe_client_up_to_the_limit_is_answered_and_one_more_is_told(start: Start) -> None:
    room = start(Recorder())
    clients = [room.probe() for _ in range(PROBE_LIMIT)]
    told = heard(room.probe())
    for client in clients:
        client.sendall(b"state\n")
    room.turns(1)

    assert error_of(told.removesuffix(b"(closed)")) == (
        f"closed: {PROBE_LIMIT} probe clients are connected, which is the limit"
    )
    assert told.endswith(b"\n(closed)")
    assert all(json.loads(heard(client))["moving"] is False for client in clients)


def test_a_probe_client_that_goes_frees_its_place(start: Start) -> None:
    room = start(Recorder())
    clients = [room.probe() for _ in range(PROBE_LIMIT)]
    clients[7].close()
    room.turns(1)
    next_one = room.probe()
    next_one.sendall(b"state\n")
    room.turns(1)

    assert json.loads(heard(next_one))["moving"] is False


def test_a_crowd_that_knocks_is_taken_in_parts(start: Start) -> None:
    room = start(Recorder())
    for _ in range(100):
        room.connecting()
    room.turns(1)

    assert len(room.server.probes) == 64
    room.turns(1)
    assert len(room.server.probes) == 100


@pytest.mark.parametrize("end", [b"", b"\nstate\n"], ids=["open", "ended"])
def test_a_request_line_that_is_too_long_is_told_and_closed(start: Start, end: bytes) -> None:
    client = (room := start(Recorder())).probe()
    client.sendall(b"x" * REQUEST_LIMIT)
    room.turns(2)
    assert heard(client) == b""
    client.sendall(b"x" + end)
    room.turns(3)

    line, closed = heard(client).splitlines()
    assert error_of(line) == f"closed: a request line is longer than {REQUEST_LIMIT} bytes"
    assert closed == b"(closed)"


def test_a_request_line_of_the_limit_is_answered(start: Start) -> None:
    client = (room := start(Recorder())).probe()
    client.sendall(b"state".ljust(REQUEST_LIMIT) + b"\n")
    room.turns(3)

    assert json.loads(heard(client))["moving"] is False


# nobody waits for another


def test_a_flood_of_requests_is_answered_one_a_turn_and_the_device_goes_on(start: Start) -> None:
    device = Patient()  # only what waits makes a turn
    room = start(device)
    flood, probe, host = room.probe(), room.probe(), room.host()
    flood.sendall(b"state\n" * 10_000)
    room.turns(1)
    probe.sendall(b"state\n")
    host.sendall(b"\x10")
    room.turns(1)

    assert device.events == ["look", "receive", "look", "look"]
    assert heard(probe).count(b"\n") == 1
    room.turns(98)
    assert heard(flood).count(b"\n") == 100  # none is left out


def test_requests_that_came_together_are_all_answered_without_further_bytes(start: Start) -> None:
    client = (room := start(Patient())).probe()
    client.sendall(b"state\n" * 3)
    room.turns(3)

    assert heard(client).count(b"\n") == 3


def test_a_probe_is_answered_before_200_slow_clients_next_bytes_are_taken(start: Start) -> None:
    device = Recorder()
    room = start(device)
    slow = [room.probe() for _ in range(200)]
    probe = room.probe()
    for client in slow:
        client.sendall(b"stat")
    room.turns(1)
    for client in slow:
        client.sendall(b"e\n" + b"state\n" * 50 + b"st")
    probe.sendall(b"state\n")
    room.turns(1)

    assert json.loads(heard(probe))["moving"] is False
    assert device.events.count("look") <= len(slow) + 1
    room.turns(50)
    assert {heard(client).count(b"\n") for client in slow} == {51}


def test_a_host_that_floods_leaves_the_rest_for_the_next_turn(start: Start) -> None:
    device = Recorder()
    room = start(device)
    host, probe = room.host(), room.probe()
    host.sendall(bytes(1 << 17))
    probe.sendall(b"state\n")
    room.turns(1)

    assert device.bytes <= 1 << 14
    assert json.loads(heard(probe))["moving"] is False
    room.turns(20)
    assert device.bytes == 1 << 17


# a client that does not read

BIG = 8192  # bytes of an answer: a few fill what the system keeps


def unread(room: Room) -> socket.socket:
    """A client that has asked so often without reading that the server is about to close it."""
    client = room.probe(buffer=4096)
    ours = room.server.probes[0]
    with socket.socket(fileno=os.dup(ours.stream.fileno())) as side:
        # Otherwise the system takes more and more, and what was unread may all be sent after all.
        side.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    while ours.leaves is None:
        client.sendall(b"state\n")
        room.turns(1)
    return client


def test_answers_are_never_dropped_and_who_does_not_read_them_is_told_the_limit(
    start: Start,
) -> None:
    client = unread(room := start(Recorder(BIG)))
    came = b""
    while not came.endswith(b"(closed)"):
        came += heard(client)
        room.turns(1)

    *answers, reason, _ = came.splitlines()
    assert all(json.loads(line)["filler"] == "x" * BIG for line in answers)
    assert error_of(reason) == (
        f"closed: {UNREAD_LIMIT} bytes of answers were not read, which is the limit"
    )


def test_who_never_reads_is_closed_after_3_s(start: Start) -> None:
    room = start(Recorder(BIG))
    unread(room)
    room.now += 3 * SECOND - 1
    room.turns(1)
    assert len(room.server.probes) == 1
    room.now += 1
    room.turns(1)

    assert not room.server.probes


# file descriptors


def test_descriptors_above_1024_are_served(start: Start) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # A machine that allows fewer has none above 1024: there the highest that it has is tried.
    most = 2048 if hard == resource.RLIM_INFINITY else min(hard, 2048)
    room = start(Recorder())
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))
        for _ in range(min(1100, most - 200)):
            stack.callback(os.close, os.dup(room.stopper.fileno()))
        client = room.probe()
        client.sendall(b"state\n")
        room.turns(1)
        assert json.loads(heard(client))["moving"] is False


@contextmanager
def no_descriptor_left() -> Iterator[None]:
    """Let this process open no more files until the block ends."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    reader, writer = os.pipe()
    os.close(reader)
    os.close(writer)
    free = min(reader, writer)  # the lowest that is free: all below are taken
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.waits
def test_without_a_free_descriptor_the_server_waits_until_one_is_free(start: Start) -> None:
    room = start(Patient())
    first = room.probe()
    second = room.connecting()
    second.sendall(b"state\n")
    stop = threading.Timer(0.5, room.stopper.stop)
    stop.start()
    turns = 0
    with no_descriptor_left():
        first.sendall(b"state\n")
        while room.server.turn():
            turns += 1
        assert json.loads(heard(first))["moving"] is False
    stop.join()
    room.stopper.withdraw(0)
    assert turns < 50  # a loop that spins makes tens of thousands
    assert room.notes == [NO_DESCRIPTOR]

    room.turns(2)
    assert json.loads(heard(second))["moving"] is False


def test_a_client_that_leaves_lets_the_next_in_at_once(start: Start) -> None:
    room = start(Recorder())
    first = room.probe()
    second = room.connecting()
    second.sendall(b"state\n")
    with no_descriptor_left():
        room.turns(2)
        first.shutdown(socket.SHUT_WR)  # the server's descriptor becomes free, ours does not
        room.turns(2)
        assert json.loads(heard(second))["moving"] is False


# addresses


@pytest.mark.parametrize("address", ["127.0.0.1:0", "localhost:0", "127.9.9.9:0"])
def test_nothing_is_said_of_an_address_of_this_machine_alone(address: str) -> None:
    with Listener(address) as listener:
        assert listener.warning("read it") == ""


def has_ipv6() -> bool:
    """Whether this machine has addresses of IPv6 to listen on."""
    try:
        with socket.create_server(("::", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False


@pytest.mark.parametrize("host", ["0.0.0.0", "0", *(["[::]"] if has_ipv6() else [])])
def test_who_can_connect_to_an_open_address_is_said(host: str) -> None:
    with Listener(f"{host}:0") as listener:
        assert listener.warning("read it") == (
            f"{listener.address} is open to the network: anybody there can read it"
        )


def told_by(served: Running, lines: int) -> tuple[list[str], list[str]]:
    """What a command announces, and what it says on standard error until it is stopped."""
    names = [served.stdout.readline().decode().strip() for _ in range(lines)]
    code, _, err = served.end()
    assert code == 0, err
    return names, err.decode().splitlines()


@pytest.mark.waits
def test_simulate_warns_of_addresses_that_the_network_reaches() -> None:
    words = ("--listen", "0.0.0.0:0", "--probe-listen", "0.0.0.0:0")
    with running("simulate", *words) as served:
        (port, probe), told = told_by(served, 2)

    port, probe = port.removeprefix("socket://"), probe.removeprefix("probe tcp:")
    assert told == [
        f"{port} is open to the network: anybody there can drive the robot",
        f"{probe} is open to the network: anybody there can read what the robot does",
    ]


@pytest.mark.waits
def test_simulate_says_nothing_on_loopback() -> None:
    with running("simulate", "--listen", "127.0.0.1:0") as served:
        assert told_by(served, 1)[1] == []


# the command


@pytest.mark.waits
def test_1100_clients_and_a_million_newlines_leave_the_simulator_well() -> None:
    with ExitStack() as stack:
        with simulate() as served:
            address = parse_address(served.probe.removeprefix("tcp:"))
            first = stack.enter_context(socket.create_connection(address, timeout=PATIENCE))
            for _ in range(1_100):
                stack.enter_context(socket.create_connection(address, timeout=PATIENCE))
            first.sendall(b"state\n")
            assert json.loads(first.makefile().readline())["moving"] is False
            flood = threading.Thread(target=_newlines, args=(first,))
            flood.start()
            port = parse_address(served.port.removeprefix("socket://"))
            with socket.create_connection(port, timeout=PATIENCE) as host:
                host.sendall(b"\x90")
                assert host.recv(1)
            assert served.process.poll() is None
        flood.join()


def _newlines(client: socket.socket) -> None:
    with suppress(OSError):  # closed, since it reads nothing
        client.sendall(b"\n" * 1_000_000)
