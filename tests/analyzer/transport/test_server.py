"""Serving a device on ptys, TCP and the probe, in one loop that stops on request."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, wait_readable
from bilprov.analyzer.transport.server import serve
from bilprov.analyzer.transport.signals import Stopper
from bilprov.analyzer.transport.streams import parse_address
from tests.support import ROOT
from tests.support.robots import PATIENCE

pytestmark = pytest.mark.waits

ALL = bytes(range(256))
DELAY = 3_000_000  # ns between a byte and its echo


class Echo:
    """A device that sends each byte back `delay` ns later and counts what it has received."""

    def __init__(self, delay: int = 0) -> None:
        self.delay = delay
        self.received = 0
        self.due: list[tuple[int, bytes]] = []
        self.early = 0

    def receive(self, data: bytes, now: int) -> None:
        self.received += len(data)
        self.due.append((now + self.delay, data))

    def advance(self, now: int) -> bytes:
        said = b""
        while self.due and self.due[0][0] <= now:
            said += self.due.pop(0)[1]
        return said

    def deadline(self) -> int | None:
        return self.due[0][0] if self.due else None

    def probe(self, now: int) -> bytes:
        return json.dumps({"moving": False, "received": self.received}).encode()


class Served:
    """A device that is served in a thread of its own."""

    def __init__(self, device: Echo, **options: object) -> None:
        self.lines: list[str] = []
        self.stopper = Stopper()
        ready = threading.Semaphore(0)

        def announce(line: str) -> None:
            self.lines.append(line)
            ready.release()

        asked: dict[str, object] = {"pty": False, "listen": None, "probe_listen": None} | options
        self.thread = threading.Thread(
            target=lambda: serve(device, announce=announce, stop=self.stopper, **asked)  # type: ignore[arg-type]
        )
        self.thread.start()
        for wanted in asked.values():
            if wanted:
                ready.acquire()

    def stop(self) -> None:
        self.stopper.stop()
        self.thread.join()
        self.stopper.close()

    def probe(self) -> socket.socket:
        host, port = parse_address(self.lines[-1].removeprefix("probe tcp:"))
        return socket.create_connection((host, port))


@pytest.fixture
def served() -> Iterator[Callable[..., Served]]:
    with contextlib.ExitStack() as stack:

        def start(device: Echo, **options: object) -> Served:
            made = Served(device, **options)
            stack.callback(made.stop)
            return made

        yield start


def read_from(port: Port, count: int) -> bytes:
    data = b""
    while len(data) < count:
        wait_readable([port], None)
        data += port.read()
    return data


def ask(probe: socket.socket, request: bytes = b"state\n") -> dict[str, object]:
    probe.sendall(request)
    line = b""
    while not line.endswith(b"\n"):
        line += probe.recv(4096)
    answer = json.loads(line)
    assert isinstance(answer, dict)
    return answer


Start = Callable[..., Served]


def test_one_line_is_announced_for_each_thing_served(served: Start) -> None:
    lines = served(Echo(), pty=True, listen="127.0.0.1:0", probe_listen="127.0.0.1:0").lines
    assert lines[0].startswith("/dev/")
    assert lines[1].startswith("socket://127.0.0.1:")
    assert lines[2].startswith("probe tcp:127.0.0.1:")


@pytest.mark.parametrize("options", [{"pty": True}, {"listen": "127.0.0.1:0"}], ids=str)
def test_every_byte_reaches_the_device_and_comes_back(
    served: Start, options: dict[str, object]
) -> None:
    with open_port(served(Echo(), **options).lines[0]) as port:
        port.write(ALL)
        assert read_from(port, 256) == ALL


def test_answers_go_to_the_side_that_spoke_last(served: Start) -> None:
    room = served(Echo(), pty=True, listen="127.0.0.1:0")
    with open_port(room.lines[0]) as pty, open_port(room.lines[1]) as client:
        for speaker, other in ((pty, client), (client, pty)):
            speaker.write(b"\x10")
            assert read_from(speaker, 1) == b"\x10"
            assert other.read() == b""


def test_answers_wait_for_their_deadline(served: Start) -> None:
    class Strict(Echo):
        def advance(self, now: int) -> bytes:
            said = super().advance(now)
            self.early += bool(self.due) and not said  # woken without anything to do
            return said

    device = Strict(DELAY)
    with open_port(served(device, pty=True).lines[0]) as port:
        for _ in range(10):
            port.write(b"\x10")
            assert read_from(port, 1) == b"\x10"
    # Once for the byte itself; a loop that spins or rounds down would wake far more often.
    assert device.early <= 20


def test_a_second_client_is_closed_and_the_first_goes_on(served: Start) -> None:
    name = served(Echo(), listen="127.0.0.1:0").lines[0]
    with open_port(name) as first:
        first.write(b"\x10")
        assert read_from(first, 1) == b"\x10"
        with (
            open_port(name) as second,
            pytest.raises(LinkError, match="was closed by the other side"),
        ):
            read_from(second, 1)
        first.write(b"\x90")
        assert read_from(first, 1) == b"\x90"


def test_a_client_that_goes_frees_its_place_and_the_device_keeps_its_state(served: Start) -> None:
    room = served(Echo(), listen="127.0.0.1:0", probe_listen="127.0.0.1:0")
    for _ in range(20):
        with open_port(room.lines[0]) as port:
            port.write(b"\x10")
            assert read_from(port, 1) == b"\x10"
    with room.probe() as probe:
        assert ask(probe)["received"] == 20


def test_a_client_that_only_ends_its_sending_still_gets_its_answers(served: Start) -> None:
    name = served(Echo(DELAY), listen="127.0.0.1:0").lines[0]
    with socket.create_connection(parse_address(name.removeprefix("socket://"))) as client:
        client.sendall(ALL)
        client.shutdown(socket.SHUT_WR)
        got = b""
        while data := client.recv(4096):
            got += data
        assert got == ALL


class Restless(Echo):
    """One that always wants to be asked again soon, as an emulated board does."""

    def deadline(self) -> int:
        return time.monotonic_ns() + 1_000_000


def test_so_it_does_from_a_device_that_never_says_that_it_is_done(served: Start) -> None:
    name = served(Restless(), listen="127.0.0.1:0").lines[0]
    address = parse_address(name.removeprefix("socket://"))
    with socket.create_connection(address, timeout=PATIENCE) as client:
        client.sendall(b"abc")
        client.shutdown(socket.SHUT_WR)
        got = b""
        while data := client.recv(4096):
            got += data
        assert got == b"abc"


def test_a_client_that_does_not_read_holds_up_nobody(served: Start) -> None:
    room = served(Echo(), listen="127.0.0.1:0", probe_listen="127.0.0.1:0")
    address = parse_address(room.lines[0].removeprefix("socket://"))
    with socket.create_connection(address) as client, room.probe() as probe:
        total = 0
        for _ in range(256):
            client.sendall(bytes(1 << 16))
            total += 1 << 16
        while ask(probe)["received"] != total:  # more than fits into one turn of the loop
            pass


# The probe


def test_a_look_sees_every_byte_that_the_host_wrote_before_it(served: Start) -> None:
    room = served(Echo(DELAY), listen="127.0.0.1:0", probe_listen="127.0.0.1:0")
    with open_port(room.lines[0]) as port, room.probe() as probe:
        for count in range(1, 200):
            port.write(b"\x10")
            assert ask(probe) == {"moving": False, "received": count, "number": 0}


def test_a_look_after_an_answer_sees_what_was_answered_on_a_pty_too(served: Start) -> None:
    room = served(Echo(), pty=True, probe_listen="127.0.0.1:0")
    with open_port(room.lines[0]) as port, room.probe() as probe:
        for count in range(1, 200):
            port.write(b"\x10")
            assert read_from(port, 1) == b"\x10"
            assert ask(probe)["received"] == count


def test_any_number_of_probes_may_look(served: Start) -> None:
    room = served(Echo(), pty=True, probe_listen="127.0.0.1:0")
    with contextlib.ExitStack() as stack:
        probes = [stack.enter_context(room.probe()) for _ in range(5)]
        for probe in [*probes, *probes]:
            assert ask(probe)["moving"] is False


def test_a_probe_repeats_the_number_of_the_question(served: Start) -> None:
    with served(Echo(), pty=True, probe_listen="127.0.0.1:0").probe() as probe:
        asked = (b"state\n", b"state 0\n", b"state 12\n", b"state 999999999999999\n")
        assert [ask(probe, one)["number"] for one in asked] == [0, 0, 12, 999999999999999]
        for wrong in (b"state x\n", b"state -1\n", b"state 1 2\n", b"state " + b"9" * 99 + b"\n"):
            assert "allowed is 'state'" in str(ask(probe, wrong)["error"])


def test_requests_that_a_probe_does_not_know_get_an_error(served: Start) -> None:
    with served(Echo(), pty=True, probe_listen="127.0.0.1:0").probe() as probe:
        assert ask(probe, b"ju\xffmp\r\n") == {
            "error": "the request is 'ju\\\\xffmp', allowed is 'state', or 'state 7' with any "
            "number"
        }
        probe.sendall(b"sta")
        assert ask(probe, b"te\n")["moving"] is False


def test_a_probe_that_ends_its_sending_is_answered_and_closed(served: Start) -> None:
    with served(Echo(), pty=True, probe_listen="127.0.0.1:0").probe() as probe:
        probe.sendall(b"state\nstate\n")
        probe.shutdown(socket.SHUT_WR)
        got = b""
        while data := probe.recv(4096):
            got += data
        assert got.count(b"\n") == 2


# Addresses


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:0", ("127.0.0.1", 0)),
        ("localhost:65535", ("localhost", 65535)),
        ("[::1]:80", ("::1", 80)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    "text", ["", "5000", ":5000", "localhost", "localhost:", "h:x", "h:65536", "::1:80", "[h]:1"]
)
def test_what_is_no_address_is_said(text: str) -> None:
    with Stopper() as stopper, pytest.raises(ValueError) as caught:
        serve(Echo(), pty=False, listen=text, probe_listen=None, announce=print, stop=stopper)
    assert str(caught.value) == f"the address is {text!r}, allowed is HOST:PORT like 127.0.0.1:0"


def test_ipv6_is_served_and_announced_in_brackets(served: Start) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:  # a machine without IPv6 has another rule to show: it is said
        with Stopper() as stopper, pytest.raises(LinkError):
            serve(
                Echo(), pty=False, listen="[::1]:0", probe_listen=None, announce=print, stop=stopper
            )
        return
    name = served(Echo(), listen="[::1]:0").lines[0]
    assert name.startswith("socket://[::1]:")
    with open_port(name) as port:
        port.write(ALL)
        assert read_from(port, 256) == ALL


def test_an_address_in_use_is_said_and_nothing_is_announced() -> None:
    said: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as taken, Stopper() as stopper:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(LinkError, match=f"^{address} is in use by another program; close it"):
            serve(
                Echo(),
                pty=True,
                listen=address,
                probe_listen=None,
                announce=said.append,
                stop=stopper,
            )
    assert not said


def test_nothing_to_serve_is_refused() -> None:
    with Stopper() as stopper, pytest.raises(ValueError, match="nothing to serve"):
        serve(
            Echo(),
            pty=False,
            listen=None,
            probe_listen="127.0.0.1:0",
            announce=print,
            stop=stopper,
        )


# Stopping

SERVING = """
from bilprov.analyzer.transport.server import serve
from bilprov.analyzer.transport.signals import Stopper
from tests.analyzer.transport.test_server import Echo
with Stopper() as stopper:
    serve(Echo(), pty=True, listen="127.0.0.1:0", probe_listen=None,
          announce=lambda line: print(line, flush=True), stop=stopper)
print("finished", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_serving_cleanly(number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", SERVING],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    with process as child:
        assert child.stdout is not None
        assert child.stderr is not None
        pty = child.stdout.readline().strip()
        child.stdout.readline()
        made = Path(pty).stat().st_ctime_ns
        child.send_signal(number)
        assert child.stdout.read() == "finished\n"
        assert child.stderr.read() == ""
        assert child.wait() == 0
    # Another test may have got a pty of the same name by now.
    with contextlib.suppress(FileNotFoundError):
        assert Path(pty).stat().st_ctime_ns != made


def test_another_thread_ends_the_serving(served: Start) -> None:
    room = served(Echo(), pty=True)
    room.stop()
    assert not room.thread.is_alive()


def test_a_stopper_puts_the_old_handlers_back() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Stopper() as stopper:
        assert not stopper.stopped
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stopper.stopped
    stopper.stop()
    stopper.close()
    assert before == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
