"""Finds a port again that was unplugged: its USB adapter where it has one, else its path."""

from __future__ import annotations

from bilprov.analyzer.transport.machine import Machine


class Place:
    """Where an open port is, and whether the same port is there again after it was unplugged.

    A USB adapter with a serial number is found under the path that it gets then; any other port
    under its own path, where another USB device does not pass for it. The number of a pty goes to
    whatever program asks for the next one, so a pty is found only behind a symbolic link that was
    made anew. A URL is never found again.
    """

    def __init__(self, name: str, machine: Machine | None = None) -> None:
        self._name = name
        self._machine = machine or Machine()
        self._usb = self._identity(name)
        self._paths = [name]
        if self._usb and self._usb[1]:
            self._paths.insert(0, self._machine.by_id(name))
        self._link = self._made() if self._machine.is_pty(name) else None
        is_link = self._machine.file(name).is_symlink()
        self.lasts = "://" not in name and (is_link or not self._machine.is_pty(name))
        """Whether the port can be found again at all."""

    def found(self) -> str:
        """The path of the port where it is there again, "" while it is not."""
        if not self.lasts or (self._link is not None and self._made() == self._link):
            return ""
        there = (path for path in self._paths if path and self._machine.file(path).exists())
        return next((path for path in there if self._identity(path) == self._usb), "")

    def _identity(self, path: str) -> tuple[str, str] | None:
        usb = self._machine.usb(path)
        return (usb.identity, usb.serial) if usb else None

    def _made(self) -> tuple[int, int] | None:
        """What tells a link from another one of the same name; None if there is none."""
        try:
            status = self._machine.file(self._name).lstat()
        except OSError:
            return None
        return status.st_ino, status.st_ctime_ns
