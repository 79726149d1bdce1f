"""The ends of a line as they are named on the command line: a device, a pty, or raw TCP served.

Every end reads and writes without waiting, and passes every byte unchanged.
"""

from __future__ import annotations

import os
from typing import Protocol

from analyzer.transport.line_settings import LineSettings
from analyzer.transport.ports import Port, open_port
from analyzer.transport.pty import PtyPair, open_pty
from analyzer.transport.streams import Outlet, accept_all, listen_on, shown_address

PTY = "pty"
LISTEN = "listen:"


class End(Protocol):
    """One end of a line: `served` is the name that others open it by, "" for an opened device."""

    served: str

    @property
    def port(self) -> Port | None:
        """What wait_readable waits for, None where `descriptors` tell."""

    def descriptors(self) -> list[int]:
        """Return what select waits for beside the port."""

    def read(self) -> bytes:
        """Return what is there. Raises LinkError once the end is lost."""

    def write_some(self, data: bytes) -> int:
        """Write what is taken now and return how many bytes. Raises LinkError."""

    def close(self) -> None:
        """Close it; more than once is as good as once."""


def require_two_ends(a: str, b: str) -> None:
    """Raise ValueError where both ends are one device (also through a symbolic link).

    Ask before opening: the second opening of a path would only say that it is in use.
    """
    if a == PTY or a.startswith(LISTEN):
        return
    if a == b or ("://" not in a + b and os.path.realpath(a) == os.path.realpath(b)):
        raise ValueError(f"both ends are {b}; a line joins two, so give another one")


def open_end(name: str, settings: LineSettings) -> End:
    """Open an end: `pty`, `listen:HOST:PORT` (port 0 takes a free one), or a path or pyserial URL.

    `settings` hold for a device. Raises ValueError for a listen address that is none; LinkError for
    what cannot be had.
    """
    if name == PTY:
        return PtyEnd(open_pty())
    if name.startswith(LISTEN):
        return ListeningEnd(name.removeprefix(LISTEN))
    return DeviceEnd(open_port(name, settings))


class DeviceEnd:
    """A port that was opened; it is lost when it is unplugged or closed by the other side."""

    def __init__(self, port: Port) -> None:
        self.served = ""
        self.port = port

    def descriptors(self) -> list[int]:
        """Return none: the port itself is waited for."""
        return []

    def read(self) -> bytes:
        """Return what is there. Raises LinkError once the port is lost."""
        return self.port.read()

    def write_some(self, data: bytes) -> int:
        """Write what the port takes now. Raises LinkError."""
        return self.port.write_some(data)

    def close(self) -> None:
        """Close the port."""
        self.port.close()


class PtyEnd:
    """A pty that programs open by its path, one after the other; it is never lost."""

    port = None

    def __init__(self, pair: PtyPair) -> None:
        self.served = pair.name
        self._pair = pair

    def descriptors(self) -> list[int]:
        """Return the pty's master."""
        return [self._pair.master]

    def read(self) -> bytes:
        """Return what the program at the path has written."""
        return self._pair.read()

    def write_some(self, data: bytes) -> int:
        """Write what the pty takes now."""
        return self._pair.write_some(data)

    def close(self) -> None:
        """Close both sides of the pty."""
        self._pair.close()


class ListeningEnd:
    """Raw TCP for one client at a time; it is never lost, and the next client takes over.

    What arrives while nobody is connected is gone, as at the open end of a cable. A client that
    only ended its sending still gets what arrives, until another one comes. Raises ValueError for
    an address that is none, LinkError for one that cannot be had.
    """

    port = None

    def __init__(self, address: str) -> None:
        self._listener = listen_on(address)
        self._client: Outlet | None = None
        self.served = f"socket://{shown_address(self._listener)}"

    def descriptors(self) -> list[int]:
        """Return the listener, and the client while it may send."""
        client = self._client
        return [
            self._listener.fileno(),
            *([client.fileno()] if client is not None and not client.ended else []),
        ]

    def read(self) -> bytes:
        """Return what the client has sent, and take in the next one where the place is free."""
        data = self._client.take() if self._client is not None else b""
        for outlet in accept_all(self._listener):
            if self._client is not None and not self._client.ended:
                outlet.close()
            else:
                self._let_go()
                self._client = outlet
                data += outlet.take()
        return data

    def write_some(self, data: bytes) -> int:
        """Write what the client takes now; without a client all of it is gone."""
        if self._client is None:
            return len(data)
        try:
            return os.write(self._client.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError:  # it went
            self._let_go()
            return len(data)

    def close(self) -> None:
        """Close the client's connection and the listener."""
        self._let_go()
        self._listener.close()

    def _let_go(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
