"""Listening sockets and non-blocking byte streams, which connect a served device to its peers."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import socket
from collections.abc import Callable

from bilprov.analyzer.transport.errors import LinkError
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
            said = _LISTENING.get(error.errno or 0, f"cannot be listened on: {error.strerror}")
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
