"""Serves one simulated device on a pty, on TCP and with a probe, in one thread with select.

For a peer that does not read, 64 KiB are kept; the rest is dropped silently, as on a serial line.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol

from bilprov.analyzer.transport.pty import open_pty
from bilprov.analyzer.transport.streams import Stream, accept_all, listen_on, shown_address

_REQUEST_LIMIT = 1024  # bytes of a probe's request line
_LINGER = 3_000_000_000  # ns without a byte after which a client that ended its sending is closed


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


class Stop(Protocol):
    """An object that ends `serve` when it becomes readable, such as a Stopper."""

    def fileno(self) -> int:
        """Return the descriptor that select waits for."""


def serve(
    device: ByteDevice,
    *,
    pty: bool,
    listen: str | None,
    probe_listen: str | None,
    announce: Callable[[str], None],
    stop: Stop,
    clock: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Serve `device` until `stop` is readable.

    `pty` asks for a pty; `listen` and `probe_listen` are addresses like `127.0.0.1:0` (port 0
    takes a free one). `announce` gets one line for each once all are open: the pty's path,
    `socket://HOST:PORT`, `probe tcp:HOST:PORT`. Answers go to the host that sent last.

    Raises ValueError for an invalid address or when there is nothing to serve; LinkError for a pty
    or an address that is not available.
    """
    if not pty and listen is None:
        raise ValueError("nothing to serve: ask for a pty or an address to listen on")
    with contextlib.ExitStack() as stack:
        server = _Server(device, clock)
        stack.callback(server.close)
        lines = []
        if pty:
            pair = stack.enter_context(open_pty())
            server.pty = Stream(pair.master, pair.close)
            lines.append(pair.name)
        if listen is not None:
            server.listener = stack.enter_context(listen_on(listen))
            lines.append(f"socket://{shown_address(server.listener)}")
        if probe_listen is not None:
            server.probe_listener = stack.enter_context(listen_on(probe_listen))
            lines.append(f"probe tcp:{shown_address(server.probe_listener)}")
        for line in lines:
            announce(line)
        while server.turn(stop):
            pass


class _Server:
    """State of the server: the device, the connections of hosts, and those of probe clients."""

    def __init__(self, device: ByteDevice, clock: Callable[[], int]) -> None:
        self.device = device
        self.clock = clock
        self.pty: Stream | None = None
        self.client: Stream | None = None
        self.active_host: Stream | None = None
        self.last = clock()  # time of the last byte in either direction
        self.probes: list[tuple[Stream, bytearray]] = []
        self.listener: socket.socket | None = None
        self.probe_listener: socket.socket | None = None

    def turn(self, stop: Stop) -> bool:
        """Run one turn of the loop: wait for events and handle them; False once `stop` is set."""
        streams = [*self._hosts(), *(stream for stream, _ in self.probes)]
        listeners = [one for one in (self.listener, self.probe_listener) if one is not None]
        readable, _, _ = select.select(
            [stop, *listeners, *(stream for stream in streams if not stream.ended)],
            [stream for stream in streams if stream.backlog],
            [],
            self._patience(),
        )
        if stop in readable:
            return False
        # The order matters: probe requests are read first, then the host's bytes that had arrived
        # by then (1 MiB at most), then the requests are answered. So a look that follows an answer
        # sees the newest state.
        asked = [
            (stream, request)
            for stream, pending in self.probes
            for request in _requests(stream, pending)
        ]
        now = self._pump()
        for stream, request in asked:
            stream.give(self._reply(request, now) + b"\n")
        for stream in streams:
            stream.flush()
        self._let_go(now)
        if self.listener is not None and self.listener in readable:
            self._accept_client(self.listener)
        if self.probe_listener is not None and self.probe_listener in readable:
            for stream in accept_all(self.probe_listener):
                self.probes.append((stream, bytearray()))
        return True

    def close(self) -> None:
        """Close every connection; the pty and the listeners belong to `serve`."""
        for stream in [self.client, *(stream for stream, _ in self.probes)]:
            if stream is not None:
                stream.close()

    def _hosts(self) -> list[Stream]:
        return [host for host in (self.pty, self.client) if host is not None]

    def _patience(self) -> float | None:
        """Return how long to wait at most, in s; select rounds up, so never before the deadline."""
        deadline = self.device.deadline()
        return None if deadline is None else max(0, deadline - self.clock()) / 1e9

    def _pump(self) -> int:
        """Pass the hosts' bytes to the device and its answers back; return the time (ns)."""
        heard = [(host, host.take()) for host in self._hosts()]
        now = self.clock()
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

    def _reply(self, request: bytes, now: int) -> bytes:
        if request == b"state":
            return self.device.probe(now)
        came = request.decode("ascii", "backslashreplace")[:80]
        return json.dumps({"error": f"the request is {came!r}, allowed is 'state'"}).encode()

    def _let_go(self, now: int) -> None:
        """Close ended connections; a client that only ended its sending gets its last answers."""
        client = self.client
        quiet = self.device.deadline() is None or now - self.last > _LINGER
        if client is not None and (client.lost or (client.idle and quiet)):
            self._drop_client()
        for stream, _ in self.probes:
            if stream.lost or stream.idle:
                stream.close()
        self.probes = [probe for probe in self.probes if not probe[0].closed]

    def _drop_client(self) -> None:
        if self.client is not None:
            self.client.close()
            if self.active_host is self.client:
                self.active_host = None
            self.client = None

    def _accept_client(self, listener: socket.socket) -> None:
        """Accept a client if there is none, or if the present one has ended; refuse others."""
        for stream in accept_all(listener):
            if self.client is not None and not self.client.ended:
                stream.close()
            else:
                self._drop_client()
                self.client = stream


def _requests(stream: Stream, pending: bytearray) -> list[bytes]:
    """Return the complete lines a probe client has sent; `pending` keeps the incomplete rest."""
    pending += stream.take()
    *lines, rest = bytes(pending).split(b"\n")
    pending[:] = rest
    if len(rest) > _REQUEST_LIMIT:  # no request is that long
        stream.ended = stream.lost = True
    return [line.strip() for line in lines]
