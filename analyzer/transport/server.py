"""Serves one simulated device on a pty, on TCP and with a probe, in one thread with one selector.

No peer makes the device or another peer wait: each turn takes 16 KiB of a host and one request of
a probe client. A host that does not read is kept 64 KiB; the rest is dropped silently, as on a
serial line. A probe client that goes over one of the limits below is closed, and told which.
"""

from __future__ import annotations

import contextlib
import json
import select
import time
from collections.abc import Callable
from selectors import EVENT_READ, EVENT_WRITE, DefaultSelector
from typing import Protocol

from bilprov.analyzer.transport.pty import open_pty
from bilprov.analyzer.transport.streams import FULL_REST, NO_DESCRIPTOR, Listener, Stream

PROBE_LIMIT = 256
"""Most probe clients at a time."""
REQUEST_LIMIT = 1024
"""Most bytes in a probe client's request line."""
UNREAD_LIMIT = 1 << 15
"""Most bytes of answers kept for a probe client that does not read them."""

_DIGITS = 15  # of the number of a question
_LINGER = 3_000_000_000  # ns: for so long what is left is sent to a client before it is closed


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
        """Return the descriptor that a selector waits for."""


def serve(
    device: ByteDevice,
    *,
    pty: bool,
    listen: str | None,
    probe_listen: str | None,
    announce: Callable[[str], None],
    stop: Stop,
    note: Callable[[str], None] = lambda _: None,
    clock: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Serve `device` until `stop` is readable.

    `pty` asks for a pty; `listen` and `probe_listen` are addresses like `127.0.0.1:0` (port 0
    takes a free one). `announce` gets one line for each once all are open: the pty's path,
    `socket://HOST:PORT`, `probe tcp:HOST:PORT`. Answers go to the host that sent last. `note` gets
    a sentence for an address that other machines reach, and when no file descriptor is free.

    Raises ValueError for an invalid address or when there is nothing to serve; LinkError for a pty
    or an address that is not available.
    """
    if not pty and listen is None:
        raise ValueError("nothing to serve: ask for a pty or an address to listen on")
    with contextlib.ExitStack() as stack:
        server = Server(device, clock, stop, note)
        stack.callback(server.close)
        lines, warnings = [], []
        if pty:
            pair = stack.enter_context(open_pty())
            server.pty = Stream(pair.master, pair.close)
            lines.append(pair.name)
        if listen is not None:
            server.listener = stack.enter_context(Listener(listen))
            lines.append(f"socket://{server.listener.address}")
            warnings.append(server.listener.warning("drive the robot"))
        if probe_listen is not None:
            server.probe_listener = stack.enter_context(Listener(probe_listen))
            lines.append(f"probe tcp:{server.probe_listener.address}")
            warnings.append(server.probe_listener.warning("read what the robot does"))
        for warning in filter(None, warnings):
            note(warning)
        for line in lines:
            announce(line)
        while server.turn():
            pass


class _ProbeClient:
    """A client of the probe: its stream, its bytes that are not yet a request taken, its end."""

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.pending = bytearray()
        self.leaves: int | None = None  # when (ns) it is closed at the latest

    @property
    def waiting(self) -> bool:
        """Whether a request of it waits for the next turn."""
        return self.leaves is None and b"\n" in self.pending

    def request(self, now: int) -> bytes | None:
        """Return the next request, None if none is complete; those behind it wait for a turn."""
        if self.leaves is not None:
            self.stream.take()
            return None
        if not self.waiting:
            self.pending += self.stream.take(REQUEST_LIMIT)
        line, newline, rest = self.pending.partition(b"\n")
        if len(line) > REQUEST_LIMIT:
            self.dismiss(f"a request line is longer than {REQUEST_LIMIT} bytes", now)
        elif newline:
            self.pending = rest
            return bytes(line).strip()
        return None

    def reply(self, answer: bytes, now: int) -> None:
        """Send an answer, unless too many wait already for the client to read them."""
        if len(self.stream.backlog) > UNREAD_LIMIT:
            self.dismiss(f"{UNREAD_LIMIT} bytes of answers were not read, which is the limit", now)
        else:
            self.stream.give(answer + b"\n")

    def dismiss(self, reason: str, now: int) -> None:
        """Send why the client is closed behind its answers, and take no more requests."""
        _tell_closed(self.stream, reason)
        self.leaves = now + _LINGER

    def over(self, now: int) -> bool:
        """Whether it can be closed: it is gone, or has what it is owed, or had its time for it."""
        if self.leaves is not None:
            return self.stream.lost or not self.stream.backlog or now >= self.leaves
        return self.stream.lost or (self.stream.idle and not self.waiting)


class Server:
    """State of the server: the device, the connections of hosts, and those of probe clients."""

    def __init__(
        self,
        device: ByteDevice,
        clock: Callable[[], int],
        stop: Stop,
        note: Callable[[str], None],
    ) -> None:
        self.device = device
        self.clock = clock
        self.stop = stop
        self.note = note
        self.pty: Stream | None = None
        self.client: Stream | None = None
        self.active_host: Stream | None = None
        self.last = clock()  # time of the last byte in either direction
        self.probes: list[_ProbeClient] = []
        self.listener: Listener | None = None
        self.probe_listener: Listener | None = None
        self._selector = DefaultSelector()
        self._watched: dict[Stop | Stream | Listener, int] = {}  # for which events
        self._told_full = False
        self._watch(stop, EVENT_READ)

    def turn(self) -> bool:
        """Run one turn of the loop: wait for events and handle them; False once `stop` is set."""
        ready = self._wait()
        if self.stop in ready:
            return False
        # The order matters: probe requests are read first, then the host's bytes that had arrived
        # by then (16 KiB at most), then the requests are answered. So a look that follows an answer
        # sees the newest state.
        now = self.clock()
        asked = [
            (probe, request)
            for probe in self.probes
            if (probe.waiting or probe.stream in ready)
            and (request := probe.request(now)) is not None
        ]
        now = self._pump()
        for probe, request in asked:
            probe.reply(self._answer(request, now), now)
        for stream in self._streams():
            stream.flush()
        self._let_go(now)
        for listener, accepted in (
            (self.listener, self._accept_client),
            (self.probe_listener, self._accept_probe),
        ):
            if listener is not None and (listener.full or listener in ready):
                for stream in listener.accept():
                    accepted(stream)
                if listener.full and not self._told_full:
                    self._told_full = True
                    self.note(NO_DESCRIPTOR)
        return True

    def close(self) -> None:
        """Close every connection; the pty and the listeners belong to `serve`."""
        self._selector.close()
        for stream in [self.client, *(probe.stream for probe in self.probes)]:
            if stream is not None:
                stream.close()

    def _hosts(self) -> list[Stream]:
        return [host for host in (self.pty, self.client) if host is not None]

    def _streams(self) -> list[Stream]:
        return [*self._hosts(), *(probe.stream for probe in self.probes)]

    def _listeners(self) -> list[Listener]:
        return [one for one in (self.listener, self.probe_listener) if one is not None]

    def _wait(self) -> set[object]:
        """Wait until a peer is ready or something is due; return who is ready."""
        for listener in self._listeners():
            self._watch(listener, 0 if listener.full else EVENT_READ)
        for stream in self._streams():
            reading = 0 if stream.ended else EVENT_READ
            self._watch(stream, reading | (EVENT_WRITE if stream.backlog else 0))
        # A selector counts in whole milliseconds, and an emulated board is due every 0.1 ms: so
        # select waits, whatever the number of peers, for one descriptor.
        select.select([self._selector], [], [], self._patience())
        return {key.fileobj for key, _ in self._selector.select(0)}

    def _watch(self, peer: Stop | Stream | Listener, events: int) -> None:
        """Wait for these events of a peer from now on; for none: no longer."""
        before = self._watched.get(peer, 0)
        if events == before:
            return
        if not events:
            self._selector.unregister(peer)
            del self._watched[peer]
            return
        if before:
            self._selector.modify(peer, events)
        else:
            self._selector.register(peer, events)
        self._watched[peer] = events

    def _patience(self) -> float | None:
        """Return how long to wait at most, in s; select rounds up, so never before the deadline."""
        if any(probe.waiting for probe in self.probes):
            return 0
        now = self.clock()
        due = [self.device.deadline(), *(probe.leaves for probe in self.probes)]
        due += [now + FULL_REST for listener in self._listeners() if listener.full]
        first = min((time for time in due if time is not None), default=None)
        return None if first is None else max(0, first - now) / 1e9

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

    def _answer(self, request: bytes, now: int) -> bytes:
        word, _, number = request.partition(b" ")
        number = number or b"0"
        if word == b"state" and number.isdigit() and len(number) <= _DIGITS:
            look = json.loads(self.device.probe(now))
            return json.dumps(look | {"number": int(number)}, separators=(",", ":")).encode()
        came = request.decode("ascii", "backslashreplace")[:80]
        return _error(f"the request is {came!r}, allowed is 'state', or 'state 7' with any number")

    def _let_go(self, now: int) -> None:
        """Close ended connections; a client that only ended its sending gets its last answers."""
        client = self.client
        quiet = self.device.deadline() is None or now - self.last > _LINGER
        if client is not None and (client.lost or (client.idle and quiet)):
            self._drop_client()
        over = [probe for probe in self.probes if probe.over(now)]
        for probe in over:
            self._close(probe.stream)
            self.probes.remove(probe)

    def _drop_client(self) -> None:
        if self.client is not None:
            self._close(self.client)
            if self.active_host is self.client:
                self.active_host = None
            self.client = None

    def _close(self, stream: Stream) -> None:
        self._watch(stream, 0)
        stream.close()

    def _accept_client(self, stream: Stream) -> None:
        """Take a host if there is none, or if the present one has ended; refuse others."""
        if self.client is not None and not self.client.ended:
            stream.close()
        else:
            self._drop_client()
            self.client = stream

    def _accept_probe(self, stream: Stream) -> None:
        """Take a client of the probe; one too many is told so and closed."""
        if len(self.probes) < PROBE_LIMIT:
            self.probes.append(_ProbeClient(stream))
            return
        _tell_closed(stream, f"{PROBE_LIMIT} probe clients are connected, which is the limit")
        stream.close()


def _tell_closed(stream: Stream, reason: str) -> None:
    stream.give(_error(f"closed: {reason}") + b"\n")
    stream.take()  # bytes left unread would turn the close into a reset, which can lose the reason


def _error(sentence: str) -> bytes:
    return json.dumps({"error": sentence}).encode()
