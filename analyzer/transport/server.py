"""Serve one simulated device on a pty, on TCP and with a probe: one thread, one select loop.

A peer that does not read loses what does not fit into 64 KiB, silently, as on a serial line.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol

from analyzer.transport.pty import open_pty
from analyzer.transport.signals import Stopper
from analyzer.transport.streams import Outlet, accept_all, listen_on, shown_address

__all__ = ["ByteDevice", "Stop", "Stopper", "serve"]

_REQUEST_LIMIT = 1024  # bytes of a probe's request line
_LINGER = 3_000_000_000  # ns without a byte, after which a client that sends no more has got all


class ByteDevice(Protocol):
    """A device without I/O; `now` is the clock's time in ns and never goes back."""

    def receive(self, data: bytes, now: int) -> None:
        """Take bytes from the host that arrived at `now`, after whatever was due before."""

    def advance(self, now: int) -> bytes:
        """Let time pass until `now` and return what the device sends by then."""

    def deadline(self) -> int | None:
        """Return when, in ns, `advance` is wanted next (after `now`); None: not before bytes."""

    def probe(self, now: int) -> bytes:
        """Return what can be seen of the device at `now`: one line of JSON without newline."""


class Stop(Protocol):
    """What ends the serving: a Stopper, or anything that becomes readable."""

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
    `socket://HOST:PORT`, `probe tcp:HOST:PORT`. Answers go to the host side that spoke last.

    Raises ValueError for an address that is none, or when there is nothing to serve; LinkError for
    one that cannot be had.
    """
    if not pty and listen is None:
        raise ValueError("nothing to serve: ask for a pty or an address to listen on")
    with contextlib.ExitStack() as stack:
        room = _Room(device, clock)
        stack.callback(room.close)
        lines = []
        if pty:
            pair = stack.enter_context(open_pty())
            room.pty = Outlet(pair.master, pair.close)
            lines.append(pair.name)
        if listen is not None:
            room.listener = stack.enter_context(listen_on(listen))
            lines.append(f"socket://{shown_address(room.listener)}")
        if probe_listen is not None:
            room.probe_listener = stack.enter_context(listen_on(probe_listen))
            lines.append(f"probe tcp:{shown_address(room.probe_listener)}")
        for line in lines:
            announce(line)
        while room.turn(stop):
            pass


class _Room:
    """The device, the sides that talk to it, and the probes that look at it."""

    def __init__(self, device: ByteDevice, clock: Callable[[], int]) -> None:
        self.device = device
        self.clock = clock
        self.pty: Outlet | None = None
        self.client: Outlet | None = None
        self.speaker: Outlet | None = None
        self.last = clock()  # when a byte went or came
        self.probes: list[tuple[Outlet, bytearray]] = []
        self.listener: socket.socket | None = None
        self.probe_listener: socket.socket | None = None

    def turn(self, stop: Stop) -> bool:
        """Wait for something to do and do it; False once `stop` is readable."""
        outlets = [*self._hosts(), *(outlet for outlet, _ in self.probes)]
        listeners = [one for one in (self.listener, self.probe_listener) if one is not None]
        readable, _, _ = select.select(
            [stop, *listeners, *(outlet for outlet in outlets if not outlet.ended)],
            [outlet for outlet in outlets if outlet.backlog],
            [],
            self._patience(),
        )
        if stop in readable:
            return False
        # The order is a rule: what was asked first, then the host's bytes that were there when it
        # was asked (1 MiB at most), then the answers: a look after an answer sees the newest state.
        asked = [
            (outlet, request)
            for outlet, pending in self.probes
            for request in _requests(outlet, pending)
        ]
        now = self._pump()
        for outlet, request in asked:
            outlet.give(self._reply(request, now) + b"\n")
        for outlet in outlets:
            outlet.flush()
        self._let_go(now)
        if self.listener is not None and self.listener in readable:
            self._accept_client(self.listener)
        if self.probe_listener is not None and self.probe_listener in readable:
            for outlet in accept_all(self.probe_listener):
                self.probes.append((outlet, bytearray()))
        return True

    def close(self) -> None:
        """Close every connection; the pty and the listeners belong to `serve`."""
        for outlet in [self.client, *(outlet for outlet, _ in self.probes)]:
            if outlet is not None:
                outlet.close()

    def _hosts(self) -> list[Outlet]:
        return [host for host in (self.pty, self.client) if host is not None]

    def _patience(self) -> float | None:
        """Return how long to wait at most, in s; select rounds up, so never before the deadline."""
        deadline = self.device.deadline()
        return None if deadline is None else max(0, deadline - self.clock()) / 1e9

    def _pump(self) -> int:
        """Hand the device what the hosts have sent and the hosts what it says; return the time."""
        heard = [(host, host.take()) for host in self._hosts()]
        now = self.clock()
        for host, data in heard:
            if data:
                self.device.receive(data, now)
                self.speaker = host
        said = self.device.advance(now)
        if said:
            for host in self._hosts() if self.speaker is None else [self.speaker]:
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
        """Close what has gone. A client that only ended its sending still gets its last answers."""
        client = self.client
        quiet = self.device.deadline() is None or now - self.last > _LINGER
        if client is not None and (client.lost or (client.idle and quiet)):
            self._drop_client()
        for outlet, _ in self.probes:
            if outlet.lost or outlet.idle:
                outlet.close()
        self.probes = [probe for probe in self.probes if not probe[0].closed]

    def _drop_client(self) -> None:
        if self.client is not None:
            self.client.close()
            if self.speaker is self.client:
                self.speaker = None
            self.client = None

    def _accept_client(self, listener: socket.socket) -> None:
        """Take a client in when the place is free, which a client at its end leaves at once."""
        for outlet in accept_all(listener):
            if self.client is not None and not self.client.ended:
                outlet.close()
            else:
                self._drop_client()
                self.client = outlet


def _requests(outlet: Outlet, pending: bytearray) -> list[bytes]:
    """Return the whole lines that a probe has sent; `pending` keeps the part without newline."""
    pending += outlet.take()
    *lines, rest = bytes(pending).split(b"\n")
    pending[:] = rest
    if len(rest) > _REQUEST_LIMIT:  # not a line of ours
        outlet.ended = outlet.lost = True
    return [line.strip() for line in lines]
