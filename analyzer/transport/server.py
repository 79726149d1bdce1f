"""Serves one simulated device on a pty, on TCP and with a probe, in one thread with one loop.

It serves one host over TCP and any probe clients. No peer makes the device or another peer wait:
one that does not read is kept 64 KiB; the rest is dropped silently, as on a serial line.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import select
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Openings, PtyPair, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.closing import Closing

_READ_LIMIT = 1 << 14  # bytes taken in one turn: some 20 ms of a simulator's time
_BACKLOG_LIMIT = 1 << 16  # bytes kept for a peer that does not read; what follows is dropped
_LISTENING = {
    errno.EADDRINUSE: "is in use by another program; close it, or give port 0 for a free one",
    errno.EACCES: "may not be listened on; give a port from 1024, or 0 for a free one",
    errno.EADDRNOTAVAIL: "is not an address of this machine; try 127.0.0.1:0",
}


class Peer:
    """A non-blocking byte stream to a host or a client of the probe, over a pty or a socket.

    `ended` is true once the peer sends no more, `lost` once the connection is broken; `backlog`
    are the bytes that the peer has not taken yet.
    """

    def __init__(self, file: PtyPair | socket.socket) -> None:
        self.fileno, self.close = file.fileno, file.close
        self.is_pty = isinstance(file, PtyPair)
        self.backlog = bytearray()
        self.ended = self.lost = False
        self._request = b""  # the beginning of one

    def take(self) -> bytes:
        """Return the received bytes, at most 16 KiB, without waiting; the rest stays unread."""
        try:
            data = b"" if self.ended else os.read(self.fileno(), _READ_LIMIT)
        except BlockingIOError:
            return b""
        except OSError:
            data, self.lost = b"", True
        self.ended = not data
        return data

    def requests(self) -> Sequence[bytes]:
        """Return the lines that a client of the probe has completed."""
        *lines, self._request = (self._request + self.take()).split(b"\n")
        self.lost = self.lost or len(self._request) > _LONGEST
        return lines

    def give(self, data: bytes = b"") -> None:
        """Send `data` as far as the peer takes it; keep at most 64 KiB of the rest, drop more."""
        self.backlog += data
        try:
            while self.backlog:
                del self.backlog[: os.write(self.fileno(), self.backlog)]
        except BlockingIOError:
            del self.backlog[_BACKLOG_LIMIT:]
        except OSError:
            self.ended = self.lost = True
            self.backlog.clear()


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT` or `[IPV6]:PORT`. Raises ValueError."""
    host, colon, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    if (
        not (colon and host and port.isascii() and port.isdigit() and int(port) < 1 << 16)
        or (":" in host) != bracketed
    ):
        raise ValueError(f"the address is {text!r}, allowed is HOST:PORT like 127.0.0.1:0")
    return (host[1:-1] if bracketed else host), int(port)


def listening(address: str) -> socket.socket:
    """Return a socket that listens at an address, and accepts without waiting.

    Raises ValueError for an invalid address, LinkError for one that cannot be listened on.
    """
    host, port = parse_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        why = str(error.strerror).partition(" (while ")[0]  # what Python adds names it again
        said = _LISTENING.get(error.errno or 0, f"cannot be listened on: {why}")
        raise LinkError(f"{address} {said}") from error
    listener.setblocking(False)
    return listener


def address_of(listener: socket.socket) -> str:
    """The address of a listening socket as HOST:PORT, with an IPv6 host in brackets."""
    host, port = listener.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def open_words(listener: socket.socket, reach: str) -> str:
    """Return a sentence that other machines can connect, and so `reach`; "" on loopback."""
    if ipaddress.ip_address(listener.getsockname()[0]).is_loopback:
        return ""
    return f"{address_of(listener)} is open to the network: anybody there can {reach}"


_LONGEST = 1024  # bytes of a request of a probe client: one that sends a longer one is closed
_DIGITS = 15  # of the number of a question
_MOST_PROBES = 200  # clients of the probe; their descriptors stay below what select can wait for
_LINGER = 3_000_000_000  # ns after the last byte: so long a host that ended its sending is answered


class ByteDevice(Protocol):
    """A simulated device without I/O of its own; `now` is in ns and never goes back."""

    def receive(self, data: bytes, now: int) -> None:
        """Take bytes from the host that arrived at `now`; process first what was due earlier."""

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` and return what the device sends by then."""

    def deadline(self) -> int | None:
        """Return the time (ns) of the next needed `advance`, None if bytes must come first."""

    def probe(self, now: int) -> bytes:
        """Return the observable state of the device at `now`: a line of JSON without newline."""


def serve(
    device: ByteDevice,
    *,
    pty: bool,
    listen: str | None,
    probe_listen: str | None,
    announce: Callable[[str], None],
    stop: Stopper,
    note: Callable[[str], None] = lambda _: None,
    clock: Callable[[], int] = time.monotonic_ns,
    reset: Callable[[int], None] | None = None,
) -> None:
    """Serve `device` until `stop` is readable.

    `pty` asks for a pty; `listen` and `probe_listen` are addresses like `127.0.0.1:0` (port 0
    takes a free one). `announce` gets one line for each once all are open: the pty's path,
    `socket://HOST:PORT`, `probe tcp:HOST:PORT`. Answers go to the host that sent last. `note` gets
    a sentence for an address that other machines reach, and when the probe has all clients that it
    takes. `reset` is called with the time (ns) each time a host opens the pty or connects, before
    its first byte.

    Raises ValueError for an invalid address or when there is nothing to serve; LinkError for a pty
    or an address that is not available.
    """
    if not pty and listen is None:
        raise ValueError("nothing to serve: ask for a pty or an address to listen on")
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server(device, stop, clock, reset, note))
        lines = []
        if pty:
            pair = stack.enter_context(open_pty())
            server.hosts.append(Peer(pair))
            if reset:
                server.openings = stack.enter_context(Openings(pair.name))
            lines.append(pair.name)
        for address, prefix, reach, take in (
            (listen, "socket://", "drive the robot", server.take_host),
            (probe_listen, "probe tcp:", "read what the robot does", server.take_probe),
        ):
            if address is not None:
                listener = stack.enter_context(listening(address))
                server.listeners[listener] = take
                lines.append(prefix + address_of(listener))
                if warning := open_words(listener, reach):
                    note(warning)
        for line in lines:
            announce(line)
        while server.turn():
            pass


@dataclass(eq=False)
class Server(Closing):
    """State of the server: the device, the connections of hosts, and those of probe clients.

    `hosts` are the pty and a client over TCP, as far as there are any; answers go to the `speaker`,
    who spoke last. `last` is the time (ns) of the last byte in either direction. `listeners` has
    for each who takes what connects.
    """

    device: ByteDevice
    stop: Stopper
    clock: Callable[[], int]
    reset: Callable[[int], None] | None = None
    note: Callable[[str], None] = lambda _: None
    openings: Openings | None = None  # of the pty
    speaker: Peer | None = None
    last: int = 0
    hosts: list[Peer] = field(default_factory=list)
    probes: list[Peer] = field(default_factory=list)
    listeners: dict[socket.socket, Callable[[Peer], None]] = field(default_factory=dict)

    def turn(self) -> bool:
        """Run one turn of the loop: wait for events and handle them; False once `stop` is set."""
        ready = self._wait()
        if self.stop in ready:
            return False
        # The order matters: probe requests are read first, then the host's bytes that had arrived
        # by then (16 KiB at most), then the requests are answered. So a look that follows an answer
        # sees the newest state.
        probes = [probe for probe in self.probes if probe in ready]
        asked = [(probe, line) for probe in probes for line in probe.requests()]
        now = self._pump([host for host in self.hosts if asked or host in ready])
        for probe, request in asked:
            probe.give(self._answer(request, now))
        for peer in (*self.hosts, *self.probes):
            peer.give()  # what waits
        self._let_go(now)
        for listener, take in self.listeners.items():
            if listener in ready:
                with contextlib.suppress(BlockingIOError, ConnectionError):  # it has gone again
                    connection, _ = listener.accept()
                    connection.setblocking(False)
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    take(Peer(connection))
        return True

    def take_host(self, peer: Peer) -> None:
        """Take a host if there is none, or if the present one has ended; refuse others."""
        for host in [host for host in self.hosts if not host.is_pty]:
            if not host.ended:
                peer.close()
                return
            self._drop(host, self.hosts)
        self.hosts.append(peer)
        if self.reset:
            self.reset(self.clock())

    def take_probe(self, peer: Peer) -> None:
        """Take a client of the probe; refuse one too many."""
        if len(self.probes) == _MOST_PROBES:
            peer.close()
            return
        self.probes.append(peer)
        if len(self.probes) == _MOST_PROBES:
            self.note(f"the probe has {_MOST_PROBES} clients: more are refused until one leaves")

    def close(self) -> None:
        """Close every connection; the listeners belong to `serve`."""
        for peer in (*self.hosts, *self.probes):
            peer.close()

    def _wait(self) -> Sequence[object]:
        """Wait until a peer is ready or the device is due; return who can be read or accepted."""
        peers = [*self.hosts, *self.probes]
        reading: list[Any] = [self.stop, *self.listeners]
        reading += [peer for peer in peers if not peer.ended]
        reading += self.openings.descriptors if self.openings else []
        deadline = self.device.deadline()
        # select rounds up: it never returns before the deadline.
        patience = None if deadline is None else max(0, deadline - self.clock()) / 1e9
        return select.select(reading, [peer for peer in peers if peer.backlog], [], patience)[0]

    def _pump(self, ready: Sequence[Peer]) -> int:
        """Pass the bytes of hosts to the device and its answers back; return the time (ns)."""
        heard = [(host, data) for host in ready if (data := host.take())]
        now = self.clock()
        if self.reset and self.openings and self.openings.taken():
            self.reset(now)
        for host, data in heard:
            self.device.receive(data, now)
            self.speaker = host
        said = self.device.advance(now)
        for host in self.hosts:
            if self.speaker in (host, None):
                host.give(said)
        if said or heard:
            self.last = now
        return now

    def _answer(self, request: bytes, now: int) -> bytes:
        """The line of JSON for a request of a probe client."""
        word, _, number = request.strip().partition(b" ")
        number = number or b"0"
        if word == b"state" and number.isdigit() and len(number) <= _DIGITS:
            look = msgspec.json.decode(self.device.probe(now)) | {"number": int(number)}
        else:
            came = request.strip().decode("ascii", "backslashreplace")[:80]
            allowed = "allowed is 'state', or 'state 7' with any number"
            look = {"error": f"the request is {came!r}, {allowed}"}
        return msgspec.json.encode(look) + b"\n"

    def _let_go(self, now: int) -> None:
        """Close ended connections; a client that only ended its sending gets its last answers."""
        quiet = self.device.deadline() is None or now - self.last > _LINGER
        for peers, answered in ((self.hosts, quiet), (self.probes, True)):
            for peer in list(peers):
                if peer.lost or (peer.ended and not peer.backlog and answered):
                    self._drop(peer, peers)

    def _drop(self, peer: Peer, peers: list[Peer]) -> None:
        peer.close()
        peers.remove(peer)
        if self.speaker is peer:
            self.speaker = None
