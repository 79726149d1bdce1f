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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Openings, open_pty
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.closing import Closing

_READ_LIMIT = 1 << 14  # bytes taken in one turn: some 20 ms of a simulator's time
_BACKLOG_LIMIT = 1 << 16  # bytes kept for a peer that does not read; what follows is dropped
_LISTENING = {
    errno.EADDRINUSE: "is in use by another program; close it, or give port 0 for a free one",
    errno.EACCES: "may not be listened on; give a port from 1024, or 0 for a free one",
    errno.EADDRNOTAVAIL: "is not an address of this machine; try 127.0.0.1:0",
}


class Stream(Closing):
    """A non-blocking byte stream to one peer.

    `ended` is true once the peer sends no more, `lost` once the connection is broken; `backlog`
    are the bytes that the peer has not taken yet.
    """

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self.backlog = bytearray()
        self.ended = False
        self.lost = False
        self._descriptor = descriptor
        self._close = close

    def fileno(self) -> int:
        """Return the descriptor that select waits for."""
        return self._descriptor

    def take(self) -> bytes:
        """Return the received bytes, at most 16 KiB, without waiting; the rest stays unread."""
        try:
            data = b"" if self.ended else os.read(self._descriptor, _READ_LIMIT)
        except BlockingIOError:
            return b""
        except OSError:
            data, self.lost = b"", True
        self.ended = not data
        return data

    def give(self, data: bytes = b"") -> None:
        """Send `data` as far as the peer takes it; keep at most 64 KiB of the rest, drop more."""
        self.backlog += data
        try:
            while self.backlog:
                del self.backlog[: os.write(self._descriptor, self.backlog)]
        except BlockingIOError:
            del self.backlog[_BACKLOG_LIMIT:]
        except OSError:
            self.ended = self.lost = True
            self.backlog.clear()

    def close(self) -> None:
        """Close the stream; further calls do nothing."""
        self._close()


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


class Listener(Closing):
    """A listening socket that accepts without waiting.

    Raises ValueError for an invalid address, LinkError for one that cannot be listened on.
    """

    def __init__(self, address: str) -> None:
        host, port = parse_address(address)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            why = str(error.strerror).partition(" (while ")[0]  # what Python adds names it again
            said = _LISTENING.get(error.errno or 0, f"cannot be listened on: {why}")
            raise LinkError(f"{address} {said}") from error
        self._socket.setblocking(False)

    @property
    def address(self) -> str:
        """The address as HOST:PORT, with an IPv6 host in brackets."""
        host, port = self._socket.getsockname()[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def warning(self, reach: str) -> str:
        """Return a sentence that other machines can connect, and so `reach`; "" on loopback."""
        host = self._socket.getsockname()[0]
        if ipaddress.ip_address(host).is_loopback:
            return ""
        return f"{self.address} is open to the network: anybody there can {reach}"

    def fileno(self) -> int:
        """Return the descriptor that a selector waits for."""
        return self._socket.fileno()

    def accept(self) -> Stream | None:
        """Return a Stream for a connection that waits, None if there is none."""
        with contextlib.suppress(BlockingIOError, ConnectionError):  # it has gone in the meantime
            connection, _ = self._socket.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return Stream(connection.fileno(), connection.close)
        return None

    def close(self) -> None:
        """Close it; further calls do nothing."""
        self._socket.close()


_LONGEST = 1024  # bytes of a request of a probe client: one that sends a longer one is closed
_DIGITS = 15  # of the number of a question
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
    a sentence for an address that other machines reach. `reset` is called with the time (ns) each
    time a host opens the pty or connects, before its first byte.

    Raises ValueError for an invalid address or when there is nothing to serve; LinkError for a pty
    or an address that is not available.
    """
    if not pty and listen is None:
        raise ValueError("nothing to serve: ask for a pty or an address to listen on")
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server(device, stop, clock, reset))
        lines, warnings = [], []
        if pty:
            pair = stack.enter_context(open_pty())
            server.pty = Stream(pair.master, pair.close)
            if reset:
                server.openings = stack.enter_context(Openings(pair.name))
            lines.append(pair.name)
        for address, prefix, reach, take in (
            (listen, "socket://", "drive the robot", server.take_host),
            (probe_listen, "probe tcp:", "read what the robot does", server.take_probe),
        ):
            if address is not None:
                listener = stack.enter_context(Listener(address))
                server.listeners[listener] = take
                lines.append(prefix + listener.address)
                warnings.append(listener.warning(reach))
        for warning in filter(None, warnings):
            note(warning)
        for line in lines:
            announce(line)
        while server.turn():
            pass


@dataclass(eq=False)
class Server(Closing):
    """State of the server: the device, the connections of hosts, and those of probe clients.

    `last` is the time (ns) of the last byte in either direction. `probes` are the clients with the
    bytes that are not yet a whole request, `listeners` those with who takes what comes.
    """

    device: ByteDevice
    stop: Stopper
    clock: Callable[[], int]
    reset: Callable[[int], None] | None = None
    openings: Openings | None = None  # of the pty
    pty: Stream | None = None
    client: Stream | None = None
    active_host: Stream | None = None
    last: int = 0
    probes: dict[Stream, bytes] = field(default_factory=dict)
    listeners: dict[Listener, Callable[[Stream], None]] = field(default_factory=dict)

    def turn(self) -> bool:
        """Run one turn of the loop: wait for events and handle them; False once `stop` is set."""
        ready = self._wait()
        if self.stop in ready:
            return False
        # The order matters: probe requests are read first, then the host's bytes that had arrived
        # by then (16 KiB at most), then the requests are answered. So a look that follows an answer
        # sees the newest state.
        heard = [probe for probe in self.probes if probe in ready]
        asked = [(probe, line) for probe in heard for line in self._requests(probe)]
        now = self._pump([host for host in self._hosts() if asked or host in ready])
        for probe, request in asked:
            probe.give(self._answer(request, now))
        for stream in self._streams():
            stream.give()  # what waits
        self._let_go(now)
        for listener, take in self.listeners.items():
            if listener in ready and (peer := listener.accept()):
                take(peer)
        return True

    def take_host(self, stream: Stream) -> None:
        """Take a host if there is none, or if the present one has ended; refuse others."""
        if self.client is not None and not self.client.ended:
            stream.close()
        else:
            self._drop_client()
            self.client = stream
            if self.reset:
                self.reset(self.clock())

    def take_probe(self, stream: Stream) -> None:
        """Take a client of the probe."""
        self.probes[stream] = b""

    def close(self) -> None:
        """Close every connection; the pty and the listeners belong to `serve`."""
        for stream in filter(None, (self.client, *self.probes)):
            stream.close()

    def _hosts(self) -> list[Stream]:
        return [host for host in (self.pty, self.client) if host is not None]

    def _streams(self) -> list[Stream]:
        return [*self._hosts(), *self.probes]

    def _wait(self) -> Sequence[object]:
        """Wait until a peer is ready or the device is due; return who can be read or accepted."""
        streams = self._streams()
        reading: list[Any] = [self.stop, *self.listeners]
        reading += [one for one in streams if not one.ended]
        reading += self.openings.descriptors if self.openings else []
        deadline = self.device.deadline()
        # select rounds up: it never returns before the deadline.
        patience = None if deadline is None else max(0, deadline - self.clock()) / 1e9
        return select.select(reading, [one for one in streams if one.backlog], [], patience)[0]

    def _pump(self, hosts: Sequence[Stream]) -> int:
        """Pass the bytes of hosts to the device and its answers back; return the time (ns)."""
        heard = [(host, host.take()) for host in hosts]
        now = self.clock()
        if self.reset and self.openings and self.openings.taken():
            self.reset(now)
        for host, data in heard:
            if data:
                self.device.receive(data, now)
                self.active_host = host
        said = self.device.advance(now)
        if said:
            for host in self._hosts() if self.active_host is None else [self.active_host]:
                host.give(said)
        if said or any(data for _, data in heard):
            self.last = now
        return now

    def _requests(self, probe: Stream) -> Iterator[bytes]:
        """Yield the request lines that a probe client has completed."""
        *lines, rest = (self.probes[probe] + probe.take()).split(b"\n")
        self.probes[probe] = rest
        probe.lost = probe.lost or len(rest) > _LONGEST
        yield from lines

    def _answer(self, request: bytes, now: int) -> bytes:
        word, _, number = request.strip().partition(b" ")
        number = number or b"0"
        if word == b"state" and number.isdigit() and len(number) <= _DIGITS:
            look = msgspec.json.decode(self.device.probe(now)) | {"number": int(number)}
            return msgspec.json.encode(look) + b"\n"
        came = request.strip().decode("ascii", "backslashreplace")[:80]
        return _error(f"the request is {came!r}, allowed is 'state', or 'state 7' with any number")

    def _let_go(self, now: int) -> None:
        """Close ended connections; a client that only ended its sending gets its last answers."""
        client = self.client
        if client is not None:
            quiet = self.device.deadline() is None or now - self.last > _LINGER
            if client.lost or (client.ended and not client.backlog and quiet):
                self._drop_client()
        for probe in list(self.probes):
            if probe.lost or (probe.ended and not probe.backlog):
                probe.close()
                del self.probes[probe]

    def _drop_client(self) -> None:
        if self.client is not None:
            self.client.close()
            if self.active_host is self.client:
                self.active_host = None
            self.client = None


def _error(sentence: str) -> bytes:
    return msgspec.json.encode({"error": sentence}) + b"\n"
