"""Waits for a port, and finds an unplugged one: its USB adapter where it has one, else its path."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.spec.errors import UserError

T = TypeVar("T")

LOOK_AGAIN = 0.2
"""Seconds between looks whether a port is there again."""


class Place:
    """Where an open port is, and whether the same port is there again after it was unplugged.

    A USB adapter with a serial number is found under the path that it gets then; any other port
    under its own path, where another USB device does not pass for it. The number of a pty goes to
    whatever program asks for the next one, so a pty is found only behind a symbolic link that was
    made anew. A URL is never found again.
    """

    def __init__(self, name: str, machine: Machine | None = None) -> None:
        self._machine = machine or Machine()
        self._usb = self._identity(name)
        self._paths = [name]
        if self._usb and self._usb[1]:
            self._paths.insert(0, self._machine.by_id(name))
        self._file, is_pty = self._machine.file(name), self._machine.is_pty(name)
        self._link = _node(self._file) if is_pty else None
        self.lasts = "://" not in name and (self._file.is_symlink() or not is_pty)
        """Whether the port can be found again at all."""

    def found(self) -> str:
        """The path of the port where it is there again, "" while it is not."""
        if not self.lasts or (self._link is not None and _node(self._file) == self._link):
            return ""
        there = (path for path in self._paths if path and self._machine.file(path).exists())
        return next((path for path in there if self._identity(path) == self._usb), "")

    def _identity(self, path: str) -> tuple[str, str] | None:
        usb = self._machine.usb(path)
        return (usb.identity, usb.serial) if usb else None


def _node(path: Path) -> tuple[int, ...] | None:
    """What tells a file, or the link to it, from that of another plugging in; None for no file."""
    try:
        there, named = path.stat(), path.lstat()
    except OSError:
        return None
    # The number of a pty's file comes again, so that a link to one is told by itself.
    return (there.st_ino, *([named.st_ino, named.st_ctime_ns] if path.is_symlink() else []))


class PathWatch:
    """Notices that a port with a path, which nobody holds here, was unplugged and is there again.

    `name` is its path: an adapter with a serial number may get another one.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._place = Place(name)
        self._was = _node(Path(name))

    def returned(self) -> bool:
        """Whether it has gone and come back since this was last true, or since the beginning."""
        path = self._place.found()
        was, self._was = self._was, _node(Path(path)) if path else None
        if self._was in (None, was):
            return False
        self.name, self._place = path, Place(path)
        return True

    def begin(self, *, lost: bool) -> None:
        """Nobody holds the port from now on. It has been watched all the time."""

    def end(self) -> None:
        """The port is about to be opened."""


@dataclass(eq=False)
class ConnectionWatch:
    """Notices that a device behind a URL was out of reach and is reachable again.

    Meanwhile it holds a connection, since only its end shows that. `settings` are the line's.
    """

    name: str
    settings: LineSettings
    _held: Port | None = None
    _gone: bool = False

    def begin(self, *, lost: bool) -> None:
        """Nobody else holds a connection from now on; `lost` where the last one has broken."""
        self._gone = lost
        if not lost:
            self.returned()

    def returned(self) -> bool:
        """Whether it has gone and come back since this was last true, or since `begin`."""
        try:
            if self._held is None:
                self._held = open_port(self.name, self.settings)
            self._held.read()
        except LinkError:
            self.end()
            self._gone = True
            return False
        back, self._gone = self._gone, False
        return back

    def end(self) -> None:
        """The connection is about to be made elsewhere."""
        if self._held is not None:
            self._held.close()
        self._held = None


def opened_when_there(
    opened: Callable[[], T],
    stopped: Callable[[], bool],
    tell: Callable[[str], object] = lambda sentence: None,
    seconds: float = math.inf,
    absent: tuple[type[UserError], ...] = (LinkError,),
) -> T | None:
    """What `opened` gives once it is not `absent`; None if `stopped`, or `seconds` are over.

    `absent` are the errors that say so. `tell` is told why it is waited for, each reason once.
    """
    said = ""
    until = time.monotonic() + seconds
    while not stopped() and time.monotonic() < until:
        try:
            return opened()
        except absent as error:
            if str(error) != said:
                said = str(error)
                tell(f"{said}; waiting")
        time.sleep(LOOK_AGAIN)
    return None


def opened_again(
    place: Place,
    settings: LineSettings,
    lost: LinkError,
    stopped: Callable[[], bool],
    seconds: float = math.inf,
) -> Port | None:
    """The port that was lost, once it is there again; None if `stopped`, or `seconds` are over.

    Raises `lost` for a port that cannot be found again.
    """
    if not place.lasts:
        raise lost

    def opened() -> Port:
        path = place.found()
        if not path:
            raise lost
        return open_port(path, settings)

    return opened_when_there(opened, stopped, seconds=seconds)
