"""Listening sockets and non-blocking byte streams, which connect a served device to its peers."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Iterator

from bilprov.analyzer.transport.errors import LinkError

_READ_LIMIT = 1 << 20  # bytes taken in one turn, so that a flood cannot hold the loop
_BACKLOG_LIMIT = 1 << 16  # bytes kept for a peer that does not read; what follows is dropped
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
        """Return the descriptor that select waits for."""
        return self._descriptor

    def take(self) -> bytes:
        """Return the received bytes without waiting; set `ended` and `lost` if the stream ended."""
        taken = bytearray()
        while not self.ended and len(taken) < _READ_LIMIT:
            try:
                data = os.read(self._descriptor, 1 << 16)
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


def listen_on(address: str) -> socket.socket:
    """Return a listening socket.

    Raises ValueError for an invalid address, LinkError for one that cannot be listened on.
    """
    host, port = parse_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        said = _LISTENING.get(error.errno or 0, f"cannot be listened on: {error.strerror}")
        raise LinkError(f"{address} {said}") from error
    listener.setblocking(False)
    return listener


def shown_address(listener: socket.socket) -> str:
    """Return the address of `listener` as HOST:PORT, with an IPv6 host in brackets."""
    host, port = listener.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def accept_all(listener: socket.socket) -> Iterator[Stream]:
    """Yield a Stream for every connection that waits at `listener`, with TCP_NODELAY set."""
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:  # none left, or a connection that closed before it was accepted
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield Stream(connection.fileno(), connection.close)
