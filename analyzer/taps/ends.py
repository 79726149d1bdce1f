"""The ends of a line, as named on the command line: a device, a pty, or a raw TCP listener.

Every end reads and writes without waiting, and passes every byte unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, same_line
from bilprov.analyzer.transport.pty import open_pty
from bilprov.analyzer.transport.streams import Listener, Stream


def require_two_ends(a: str, b: str) -> None:
    """Raise ValueError if both ends are the same device (also through a symbolic link).

    Call this before opening: opening a path twice would only report that it is in use.
    """
    if _served_kind(a) is None and same_line(a, b):
        raise ValueError(f"both ends are {b}; a line joins two, so give another one")


def open_end(name: str, settings: LineSettings) -> End:
    """Open an end: a kind of `SERVED`, or a path or pyserial URL of a device.

    `settings` apply to a device. Raises ValueError for an invalid listen address, LinkError for an
    end that cannot be opened.
    """
    kind = _served_kind(name)
    if kind is not None:
        return kind.opened(name.removeprefix(kind.prefix))
    port = open_port(name, settings)
    return OpenedEnd(port.read, port.write_some, port.close, port=port)


@dataclass(slots=True)
class OpenedEnd:
    """An opened port or pty as an end; a port is lost when unplugged, a pty never.

    `read` returns the available bytes and raises LinkError once the end is lost, `write_some`
    returns how many bytes were taken. `served` is the name under which others open the end, "" for
    a device; `port` is what wait_readable waits for, None if there are only `waited` descriptors.
    `warning` and `full` are a listener's: nobody connects to this end.
    """

    read: Callable[[], bytes]
    write_some: Callable[[bytes], int]
    close: Callable[[], None]
    served: str = ""
    port: Port | None = None
    waited: tuple[int, ...] = ()
    warning: str = ""
    full: bool = False

    def descriptors(self) -> list[int]:
        """Return the descriptors that select waits for besides the port."""
        return list(self.waited)


def _pty_end(_: str) -> End:
    """Return a new pty as an end; programs open it by its path, one after the other."""
    pair = open_pty()
    return OpenedEnd(pair.read, pair.write_some, pair.close, pair.name, waited=(pair.master,))


class ListeningEnd:
    """A raw TCP listener as an end, for one client at a time. It is never lost.

    Bytes that arrive while no client is connected are dropped, as at the open end of a cable. A
    client that only ended its sending still gets what arrives, until another one connects.
    `warning` is a sentence if other machines reach the address, else "". Raises ValueError for an
    invalid address, LinkError for one that is not available.
    """

    port = None

    def __init__(self, address: str) -> None:
        self._listener = Listener(address)
        self._client: Stream | None = None
        self.served = f"socket://{self._listener.address}"
        self.warning = self._listener.warning("drive the robot and read what it answers")

    def descriptors(self) -> list[int]:
        """Return the listener, unless it is full, and the client while it may send."""
        client = self._client
        return [
            *([] if self._listener.full else [self._listener.fileno()]),
            *([client.fileno()] if client is not None and not client.ended else []),
        ]

    @property
    def full(self) -> bool:
        """Whether clients wait because no file descriptor is free; `read` tries again."""
        return self._listener.full

    def read(self) -> bytes:
        """Return what the client has sent; accept the next client once it has ended its sending."""
        data = self._client.take() if self._client is not None else b""
        for stream in self._listener.accept():
            if self._client is not None and not self._client.ended:
                stream.close()
            else:
                self._let_go()
                self._client = stream
                data += stream.take()
        return data

    def write_some(self, data: bytes) -> int:
        """Write what the client takes now; without a client all bytes are dropped."""
        if self._client is None:
            return len(data)
        try:
            return os.write(self._client.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError:  # the client has closed the connection
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


End: TypeAlias = OpenedEnd | ListeningEnd


class ServedKind(NamedTuple):
    """A kind of end that is made for others to open: its prefix and its help; how it is opened.

    A prefix without a colon is the whole name. `opened` gets what follows the prefix.
    """

    prefix: str
    help: str
    opened: Callable[[str], End]


SERVED = (
    ServedKind("pty", "pty (a pseudo terminal is made for a program to open)", _pty_end),
    ServedKind("listen:", "listen:HOST:PORT (raw TCP is served; port 0: any)", ListeningEnd),
)


def _served_kind(name: str) -> ServedKind | None:
    """Return the kind of served end that a name asks for, None for a device."""
    for kind in SERVED:
        if name == kind.prefix or (kind.prefix.endswith(":") and name.startswith(kind.prefix)):
            return kind
    return None
