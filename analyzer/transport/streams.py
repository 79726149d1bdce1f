"""Listening sockets and non-blocking byte streams, which connect a served device to its peers."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
from collections.abc import Callable, Iterator

from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.closing import Closing

FULL_REST = 100_000_000  # ns until a listener that found no free descriptor tries again
NO_DESCRIPTOR = (
    "no file descriptor is free: new connections wait until one is (ulimit -n shows the limit)"
)

_READ_LIMIT = 1 << 14  # bytes taken in one turn: some 20 ms of a simulator's time
_ACCEPT_LIMIT = 64  # connections taken in one turn, so that those who knock cannot hold the loop
_BACKLOG_LIMIT = 1 << 16  # bytes kept for a peer that does not read; what follows is dropped
_QUEUE = 1024  # connections that the system lets wait; one more tries again only 1 s later
_SCARCE = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
_LISTENING = {
    errno.EADDRINUSE: "is in use by another program; close it, or give port 0 for a free one",
    errno.EACCES: "may not be listened on; give a port from 1024, or 0 for a free one",
    errno.EADDRNOTAVAIL: "is not an address of this machine; try 127.0.0.1:0",
}


class Stream:
    """A non-blocking byte stream to one peer.

    `ended` is true once the peer sends no more, `lost` once the connection is broken.
    """

    def __init__(self, descriptor: int, close: Callable[[], None]) -> None:
        self.backlog = bytearray()
        self.ended = False
        self.lost = False
        self.closed = False
        self._descriptor = descriptor
        self._close = close

    @property
    def idle(self) -> bool:
        """Whether the peer has ended its sending and all bytes for it are sent."""
        return self.ended and not self.backlog

    def fileno(self) -> int:
        """Return the descriptor that a selector waits for."""
        return self._descriptor

    def take(self, limit: int = _READ_LIMIT) -> bytes:
        """Return the received bytes, at most `limit`, without waiting; what is left stays unread.

        Sets `ended`, and `lost`, if the stream ended.
        """
        taken = bytearray()
        while not self.ended and len(taken) < limit:
            try:
                data = os.read(self._descriptor, limit - len(taken))
            except BlockingIOError:
                break
            except OSError:
                self.ended = self.lost = True
                break
            self.ended = not data
            taken += data
        return bytes(taken)

    def give(self, data: bytes) -> None:
        """Send `data` as far as the peer takes it; keep at most 64 KiB of the rest, drop more."""
        if not self.closed:
            self.backlog += data
            self.flush()
            del self.backlog[_BACKLOG_LIMIT:]

    def flush(self) -> None:
        """Send as many of the kept bytes as the peer takes now."""
        while self.backlog and not self.closed:
            try:
                count = os.write(self._descriptor, self.backlog)
            except BlockingIOError:
                return
            except OSError:
                self.ended = self.lost = True
                self.backlog.clear()
                return
            del self.backlog[:count]

    def close(self) -> None:
        """Close the stream; further calls do nothing."""
        if not self.closed:
            self.closed = True
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

    While the process has no free descriptor it is `full`: connections then wait in the system's
    queue, and its owner does not wait for it (it would be readable all the time) but tries again
    in each turn, and after `FULL_REST`. Raises ValueError for an invalid address, LinkError for
    one that cannot be listened on.
    """

    def __init__(self, address: str) -> None:
        host, port = parse_address(address)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._socket = socket.create_server((host, port), family=family, backlog=_QUEUE)
        except OSError as error:
            said = _LISTENING.get(error.errno or 0, f"cannot be listened on: {error.strerror}")
            raise LinkError(f"{address} {said}") from error
        self._socket.setblocking(False)
        self.full = False

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

    def accept(self) -> Iterator[Stream]:
        """Yield a Stream, with TCP_NODELAY set, for each of the first 64 connections that wait."""
        for _ in range(_ACCEPT_LIMIT):
            try:
                connection, _ = self._socket.accept()
            except OSError as error:
                # None is left, or one closed before it was accepted, or no descriptor is free.
                self.full = error.errno in _SCARCE
                return
            self.full = False
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            yield Stream(connection.fileno(), connection.close)

    def close(self) -> None:
        """Close it; further calls do nothing."""
        self._socket.close()
