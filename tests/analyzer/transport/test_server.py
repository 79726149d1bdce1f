"""Serving a device on ptys, TCP and the probe, in one loop that stops on request."""

from __future__ import annotations

import json
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import NamedTuple

import pytest

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import open_port
from bilprov.analyzer.transport.server import (
    address_of,
    listening,
    open_words,
    parse_address,
    serve,
)
from bilprov.analyzer.transport.signals import Stopper
from tests.support.commands import running
from tests.support.robots import PATIENCE, serving
from tests.support.wires import read_from

pytestmark = pytest.mark.waits

ALL = bytes(range(256))
DELAY = 3_000_000  # ns between a byte and its echo
ANY = "127.0.0.1:0"


class Echo:
    """A device that sends each byte back `delay` ns later and counts what it has received."""

    def __init__(self, delay: int = 0, filler: int = 0) -> None:
        self.delay = delay
        self.received = 0
        self.due: list[tuple[int, bytes]] = []
        self.early = 0  # how often it was woken without anything to do
        self.filler = "x" * filler

    def receive(self, data: bytes, now: int) -> None:
        self.received += len(data)
        self.due.append((now + self.delay, data))

    def advance(self, now: int) -> bytes:
        said = b""
        while self.due and self.due[0][0] <= now:
            said += self.due.pop(0)[1]
        self.early += bool(self.due) and not said
        return said

    def deadline(self) -> int | None:
        return self.due[0][0] if self.due else None

    def probe(self, now: int) -> bytes:
        look = {"moving": False, "received": self.received}
        return json.dumps(look | ({"filler": self.filler} if self.filler else {})).encode()


class Restless(Echo):
    """One that always wants to be asked again soon, as an emulated board does."""

    def deadline(self) -> int:
        return time.monotonic_ns() + 1_000_000


class Served(NamedTuple):
    """The lines that are announced of a device that is served."""

    lines: list[str]

    def connected(self, line: int = -1) -> socket.socket:
        """A connection to the address in a line, which is the probe's unless another is named."""
        address = self.lines[line].removeprefix("socket://").removeprefix("probe tcp:")
        return socket.create_connection(parse_address(address), timeout=PATIENCE)


Start = Callable[..., Served]


@pytest.fixture
def served() -> Iterator[Start]:
    with ExitStack() as stack:
        yield lambda device, **given: Served(stack.enter_context(serving(device, **given)))


def until_closed(peer: socket.socket) -> bytes:
    got = b""
    with suppress(ConnectionResetError):
        while data := peer.recv(1 << 16):
            got += data
    return got


def ask(probe: socket.socket, request: bytes = b"state\n") -> dict[str, object]:
    probe.sendall(request)
    line = b""
    while not line.endswith(b"\n"):
        line += probe.recv(4096)
    answer = json.loads(line)
    assert isinstance(answer, dict)
    return answer


def test_one_line_is_announced_for_each_thing_served(served: Start) -> None:
    lines = served(Echo(), pty=True, listen=ANY, probe=ANY).lines
    begin = ("/dev/", "socket://127.0.0.1:", "probe tcp:127.0.0.1:")
    assert all(map(str.startswith, lines, begin))


@pytest.mark.parametrize("options", [{"pty": True}, {"listen": ANY}], ids=str)
def test_every_byte_reaches_the_device_and_comes_back(
    served: Start, options: dict[str, object]
) -> None:
    with open_port(served(Echo(), **options).lines[0]) as port:
        port.write(ALL)
        assert read_from(port, 256) == ALL


def test_answers_go_to_the_side_that_spoke_last(served: Start) -> None:
    room = served(Echo(), pty=True, listen=ANY)
    with open_port(room.lines[0]) as pty, open_port(room.lines[1]) as client:
        for speaker, other in ((pty, client), (client, pty)):
            speaker.write(b"\x10")
            assert read_from(speaker, 1) == b"\x10"
            assert other.read() == b""


class Alarm(Echo):
    """A device that speaks of its own accord after each look at it."""

    def probe(self, now: int) -> bytes:
        self.due.append((now, b"!"))
        return super().probe(now)


def test_after_a_host_has_left_the_device_is_heard_by_who_is_still_there(served: Start) -> None:
    room = served(Alarm(), pty=True, listen=ANY, probe=ANY)
    with open_port(room.lines[0]) as pty, room.connected() as probe:
        with room.connected(1) as client:
            client.sendall(b"\x10")
            assert client.recv(1) == b"\x10"
        assert "error" in ask(probe, b"x\n")  # in this turn the host is seen to have gone
        ask(probe)
        assert select.select([pty], [], [], PATIENCE)[0] == [pty]
        assert pty.read() == b"!"


def test_answers_wait_for_their_deadline(served: Start) -> None:
    device = Echo(DELAY)
    with open_port(served(device, pty=True).lines[0]) as port:
        for _ in range(10):
            port.write(b"\x10")
            assert read_from(port, 1) == b"\x10"
    # Once for the byte itself; a loop that spins or rounds down would wake far more often.
    assert device.early <= 20


def test_a_second_host_is_closed_and_the_next_finds_the_device_as_it_was(served: Start) -> None:
    room = served(Echo(), listen=ANY, probe=ANY)
    for _ in range(20):
        with open_port(room.lines[0]) as first:
            first.write(b"\x10")
            assert read_from(first, 1) == b"\x10"
            with open_port(room.lines[0]) as second, pytest.raises(LinkError, match="was closed"):
                read_from(second, 1)
            first.write(b"\x90")
            assert read_from(first, 1) == b"\x90"
    with room.connected() as probe:
        assert ask(probe)["received"] == 40


@pytest.mark.parametrize("kind", [Echo, Restless])
def test_a_host_that_only_ends_its_sending_still_gets_its_answers(
    served: Start, kind: type[Echo]
) -> None:
    with served(kind(DELAY), listen=ANY).connected() as client:
        client.sendall(ALL)
        client.shutdown(socket.SHUT_WR)
        assert until_closed(client) == ALL


def test_a_host_that_does_not_read_holds_up_nobody(served: Start) -> None:
    room = served(Echo(), listen=ANY, probe=ANY)
    with room.connected(0) as client, room.connected() as probe:
        total = 1 << 24
        client.sendall(bytes(total))
        while ask(probe)["received"] != total:  # more than fits into one turn of the loop
            pass


# The probe


def test_a_look_sees_every_byte_that_the_host_wrote_before_it(served: Start) -> None:
    room = served(Echo(DELAY), listen=ANY, probe=ANY)
    with open_port(room.lines[0]) as port, room.connected() as probe:
        for count in range(1, 200):
            port.write(b"\x10")
            assert ask(probe) == {"moving": False, "received": count, "number": 0}


def test_a_look_after_an_answer_sees_what_was_answered_on_a_pty_too(served: Start) -> None:
    room = served(Echo(), pty=True, probe=ANY)
    with open_port(room.lines[0]) as port, room.connected() as probe:
        for count in range(1, 200):
            port.write(b"\x10")
            assert read_from(port, 1) == b"\x10"
            assert ask(probe)["received"] == count


UNKNOWN = "the request is {}, allowed is 'state', or 'state 7' with any number"


@pytest.mark.parametrize(
    ("request_line", "answer"),
    [
        (b"state\n", 0),
        (b" state 0 \r\n", 0),
        (b"state 999999999999999\n", 999999999999999),
        (b"state x\n", UNKNOWN.format("'state x'")),
        (b"state -1\n", UNKNOWN.format("'state -1'")),
        (b"state 1 2\n", UNKNOWN.format("'state 1 2'")),
        (b"state 9999999999999999\n", UNKNOWN.format("'state 9999999999999999'")),
        (b"ju\xffmp\r\n", UNKNOWN.format("'ju\\\\xffmp'")),
    ],
)
def test_requests_of_a_probe_and_their_answers(
    served: Start, request_line: bytes, answer: int | str
) -> None:
    key = "error" if isinstance(answer, str) else "number"
    with served(Echo(), pty=True, probe=ANY).connected() as probe:
        assert ask(probe, request_line)[key] == answer
        probe.sendall(b"sta")
        assert ask(probe, b"te\n")["moving"] is False
        probe.sendall(b"state\nstate\n")
        probe.shutdown(socket.SHUT_WR)
        assert until_closed(probe).count(b"\n") == 2


def test_who_does_not_read_its_answers_delays_nobody(served: Start) -> None:
    room = served(Echo(filler=4096), pty=True, probe=ANY)
    with room.connected() as silent, room.connected() as probe:
        for _ in range(10):
            silent.sendall(b"state\n" * 100)
            assert ask(probe)["moving"] is False


def test_a_request_without_an_end_is_closed(served: Start) -> None:
    with served(Echo(), pty=True, probe=ANY).connected() as probe, suppress(ConnectionError):
        probe.sendall(b"x" * 2000)
        assert until_closed(probe) == b""


# Addresses


def refused(**options: object) -> tuple[type[Exception], str]:
    """The error with which serving ends before anything was announced."""
    lines: list[str] = []
    wanted = {"pty": True, "listen": None, "probe_listen": None} | options
    with Stopper() as stopper, pytest.raises((ValueError, LinkError)) as caught:
        serve(Echo(), announce=lines.append, stop=stopper, **wanted)  # type: ignore[arg-type]
    assert not lines
    return caught.type, str(caught.value)


def test_what_cannot_be_served_is_said() -> None:
    with listening(ANY) as taken:
        in_use = f"{address_of(taken)} is in use by another program; close it"
        for options, kind, sentence in (
            ({"pty": False, "probe_listen": ANY}, ValueError, "nothing to serve"),
            ({"listen": address_of(taken)}, LinkError, in_use),
        ):
            raised, said = refused(**options)
            assert raised is kind
            assert said.startswith(sentence)


@pytest.mark.parametrize(
    ("host", "warning"),
    [
        *((host, "") for host in ("127.0.0.1", "localhost", "127.9.9.9", "[::1]")),
        *((host, "{} is open to the network: anybody there can read it") for host in ("0", "[::]")),
    ],
)
def test_who_can_connect_to_an_open_address_is_said(host: str, warning: str) -> None:
    if host.startswith("["):
        try:
            listening(f"{host}:0").close()
        except LinkError:
            pytest.skip("no IPv6 here: sysctl net.ipv6.conf.all.disable_ipv6=0 brings it")
    with listening(f"{host}:0") as listener:
        assert open_words(listener, "read it") == warning.format(address_of(listener))
        assert parse_address(address_of(listener))[1] > 0


# The command


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_command_cleanly(number: signal.Signals) -> None:
    with running("simulate", "--pty", "--listen", "0.0.0.0:0") as command:
        pty, address = (command.stdout.readline().decode().strip() for _ in range(2))
        code, out, err = command.end(number)
    warning = "is open to the network: anybody there can drive the robot"
    assert (code, out) == (0, b"")
    assert err.decode().splitlines() == [f"{address.removeprefix('socket://')} {warning}"]
    assert pty.startswith("/dev/")


def test_a_client_of_the_probe_too_many_is_refused_and_the_others_are_served() -> None:
    with running("simulate", "--probe-listen", ANY) as command, ExitStack() as stack:
        room = Served([command.stdout.readline().decode().strip() for _ in range(2)])
        probes = [stack.enter_context(room.connected()) for _ in range(200)]
        with room.connected() as refused:
            assert until_closed(refused) == b""
        probes.pop().close()
        probes.append(stack.enter_context(room.connected()))
        assert [ask(probe)["moving"] for probe in probes] == [False] * 200
        code, _, err = command.end(signal.SIGTERM)
    sentence = "the probe has 200 clients: more are refused until one leaves"
    assert (code, err.decode().splitlines()) == (0, [sentence] * 2)
