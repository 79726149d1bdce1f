"""What this machine tells of its serial ports and who holds them; opens no port, changes nothing.

Read from /sys, /proc, /dev and /run/udev, without being root. Where a system has no such files
(macOS, a container) nothing is known, and nothing is guessed.
"""

from __future__ import annotations

import grp
import os
import pwd
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bilprov.captures.schemas import MS
from bilprov.spec.errors import one_line

_COMMAND_CHARACTERS = 40  # of a command line, which is enough to recognise a program
_PTYS = "/dev/pts/"
_LATER = 4  # ms by which a read may be later than its adapter's timer
# Programs that take serial ports for something else, by the name of their process.
MODEM_MANAGER, BRLTTY = "ModemManager", "brltty"


@dataclass(frozen=True, slots=True, order=True)
class Process:
    """A process: its id, its name, and the beginning of its command line."""

    pid: int
    name: str
    command: str

    def __str__(self) -> str:
        return f"{self.command} (pid {self.pid})"


@dataclass(frozen=True, slots=True)
class Held:
    """Who has a port open: `holders`, without the server at the other end of a pty.

    `own` if this process is one. `unseen` processes belong to other users, so that their open files
    cannot be seen: one of them may be a holder too.
    """

    holders: tuple[Process, ...] = ()
    unseen: int = 0
    own: bool = False


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A USB device: its folder in /sys, its vendor and product id in hex, its serial number."""

    folder: Path
    vendor: str
    product: str
    serial: str
    title: str

    @property
    def identity(self) -> str:
        """Vendor and product as `lsusb` writes them, like `0403:6001`."""
        return f"{self.vendor}:{self.product}"


@dataclass(frozen=True, slots=True)
class Owner:
    """To whom a device belongs, and whether it lets that group read and write."""

    user: str
    group: str
    group_may: bool


class Machine:
    """The files of a Linux machine below `root`, which is the machine's own unless a test says so.

    Ports are given by name: a path, also one that is a symbolic link such as those in
    /dev/serial/by-id. Nothing here raises: what is not there, or may not be read, is empty.
    """

    def __init__(self, root: str | Path = "/") -> None:
        self._root = Path(root)

    def file(self, path: str) -> Path:
        """The file that has this absolute path on the machine."""
        return self._root / path.lstrip("/")

    def device(self, name: str) -> str:
        """The path of the device that a name leads to: links resolved, as /proc shows it.

        A URL leads to none, and is returned.
        """
        if "://" in name:
            return name
        # realpath, since Path.resolve raises for links in a circle.
        here = os.path.realpath(self.file(str(Path(name).absolute())))
        root = os.path.realpath(self._root)
        return here.removeprefix(root) if here.startswith(f"{root}/") else here

    def title(self, name: str) -> str:
        """The name that the kernel gives the device, like `ttyUSB0`."""
        return Path(self.device(name)).name

    def is_pty(self, name: str) -> bool:
        """Whether the name leads to a pseudo terminal."""
        return self.device(name).startswith(_PTYS)

    def is_terminal(self, name: str) -> bool:
        """Whether the device is a serial port or another terminal; true where nothing is known."""
        known = self.file("/sys/class/tty")
        return self.is_pty(name) or not known.is_dir() or (known / self.title(name)).exists()

    # Who holds a port

    def held(self, *names: str) -> dict[str, Held]:
        """Who has each of the ports open, and which processes cannot be looked into."""
        devices = {self.device(name) for name in names}
        indexes = {path.removeprefix(_PTYS): path for path in devices if path.startswith(_PTYS)}
        holders: dict[str, set[int]] = {path: set() for path in devices}
        servers: dict[str, int] = {}
        unseen: set[int] = set()
        for pid in self._processes():
            try:
                opened = list(self.file(f"/proc/{pid}/fd").iterdir())
            except PermissionError:
                if self._read(f"/proc/{pid}/cmdline"):  # a thread of the kernel has none
                    unseen.add(pid)
                continue
            except OSError:  # it has just ended
                continue
            for entry in opened:
                path = _target(entry)
                if path in holders:
                    holders[path].add(pid)
                elif indexes and path.endswith("/ptmx"):
                    said = self._read(f"/proc/{pid}/fdinfo/{entry.name}")
                    index = said.partition("tty-index:")[2].split()[:1]
                    if index and index[0] in indexes:
                        servers[indexes[index[0]]] = pid
        own, found = os.getpid(), {}
        for path in devices:
            pids = holders[path]
            found[path] = Held(
                tuple(self.process(pid) for pid in sorted(pids - {own, servers.get(path)})),
                len(unseen - pids),
                own in pids,
            )
        return {name: found[self.device(name)] for name in names}

    def running(self, name: str) -> bool:
        """Whether a process of that name runs."""
        return any(self._read(f"/proc/{pid}/comm") == name for pid in self._processes())

    def process(self, pid: int) -> Process:
        """What anybody may see of a process."""
        name = one_line(self._read(f"/proc/{pid}/comm"))
        words = [word for word in self._read(f"/proc/{pid}/cmdline").split("\0") if word]
        # Of a program in Python its name is what counts, not where that is.
        if words and Path(words[0]).name.startswith("python"):
            words[1:2] = [Path(word).name for word in words[1:2]]
        line = " ".join([Path(words[0]).name, *words[1:]]) if words else name
        if len(line) > _COMMAND_CHARACTERS:
            line = line[: _COMMAND_CHARACTERS - 1] + "…"
        return Process(pid, name, one_line(line) or "a process without a name")

    def is_own(self, pid: int) -> bool:
        """Whether a process is this user's, who may then end it."""
        try:
            return os.geteuid() in (0, self.file(f"/proc/{pid}").stat().st_uid)
        except OSError:
            return False

    # Permission

    def owner(self, name: str) -> Owner | None:
        """To whom the device belongs; None if there is no device."""
        try:
            found = self.file(self.device(name)).stat()
        except OSError:
            return None
        rights = stat.S_IRGRP | stat.S_IWGRP
        user, group = _named(pwd.getpwuid, found.st_uid), _named(grp.getgrgid, found.st_gid)
        return Owner(user, group, found.st_mode & rights == rights)

    def is_member(self, group: str) -> bool:
        """Whether this user is listed in a group; a session that began before is not in it yet."""
        try:
            return _named(pwd.getpwuid, os.geteuid()) in grp.getgrnam(group).gr_mem
        except KeyError:  # a group without a name
            return False

    def may_open(self, name: str) -> bool:
        """Whether this process may read and write the device."""
        device, effective = self.file(self.device(name)), os.access in os.supports_effective_ids
        return os.access(device, os.R_OK | os.W_OK, effective_ids=effective)

    # The adapter

    def usb(self, name: str) -> UsbDevice | None:
        """The USB device that the port belongs to; None for any other port."""
        folder = self._folder(name)
        return next((made for up in [folder, *folder.parents] if (made := _usb(up))), None)

    def driver(self, name: str) -> str:
        """The name of the port's driver, "" if there is none."""
        folder = self._folder(name)
        while _target(folder / "subsystem").endswith("/serial-base"):
            folder = folder.parent  # newer kernels put two folders of their own in between
        return Path(_target(folder / "driver")).name

    def latency_timer(self, name: str) -> int | None:
        """For how many ms the adapter holds bytes back; None for one that has no such timer."""
        return _number(_text(self._folder(name) / "latency_timer"))

    def least_pause(self, *names: str) -> int:
        """The ns of silence that an adapter may cause by itself; 0 where no port has such a timer.

        A shorter pause between two bytes tells nothing about when they were sent.
        """
        longest = max((self.latency_timer(name) or 0 for name in names), default=0)
        return (longest + _LATER) * MS if longest else 0

    def no_hardware(self, name: str) -> bool:
        """Whether the port is a name that the driver keeps ready for a chip that is not there."""
        return self._read(f"/sys/class/tty/{self.title(name)}/type") == "0"

    def by_id(self, name: str) -> str:
        """The name in /dev/serial/by-id, which stays when adapters are plugged in anew, or ""."""
        device = self.device(name)
        with suppress(OSError):
            for entry in sorted(self.file("/dev/serial/by-id").iterdir()):
                path = f"/dev/serial/by-id/{entry.name}"
                if self.device(path) == device:
                    return path
        return ""

    def properties(self, name: str) -> Mapping[str, str]:
        """What udev's rules say of the port and its USB device, by name of the property."""
        usb = self.usb(name)
        number = self._read(f"/sys/class/tty/{self.title(name)}/dev")
        return (self._udev(_text(usb.folder / "dev")) if usb else {}) | self._udev(number)

    def taken_for_braille(self) -> UsbDevice | None:
        """A USB device that brltty has taken for a Braille display, while it runs."""
        with suppress(OSError):
            for folder in sorted(self.file("/sys/bus/usb/devices").iterdir()):
                usb = _usb(folder)
                rules = self._udev(_text(folder / "dev")) if usb else {}
                if any(key.startswith("BRLTTY_") for key in rules) and self.running(BRLTTY):
                    return usb
        return None

    def _folder(self, name: str) -> Path:
        """The folder of the port's device in /sys; one that is not there for other ports."""
        return self.file(f"/sys/class/tty/{self.title(name)}/device").resolve()

    def _udev(self, number: str) -> dict[str, str]:
        """What udev's database has of a character device, by its `MAJOR:MINOR`."""
        lines = self._read(f"/run/udev/data/c{number}").splitlines() if number else []
        pairs = (line[2:].partition("=") for line in lines if line.startswith("E:"))
        return {key: value for key, _, value in pairs}

    def _processes(self) -> Iterator[int]:
        with suppress(OSError):
            for entry in self.file("/proc").iterdir():
                if (pid := _number(entry.name)) is not None:
                    yield pid

    def _read(self, path: str) -> str:
        return _text(self.file(path))


@dataclass(frozen=True, slots=True, order=True)
class PortInfo:
    """A serial port of this machine, and what the system tells of it.

    `likely` is true for a USB adapter or board, where a robot is probably connected; `usb` is its
    vendor and product id in hex. `by_id` is the path that stays when adapters are plugged in anew,
    `latency_ms` for how long the adapter holds bytes back, None where it has no such timer.
    `holders` have the port open; `unseen` processes cannot be looked into, so one may too.
    """

    path: str
    description: str
    hardware_id: str
    likely: bool
    usb: str = ""
    serial_number: str = ""
    by_id: str = ""
    driver: str = ""
    latency_ms: int | None = None
    holders: tuple[Process, ...] = ()
    unseen: int = 0


def list_ports() -> list[PortInfo]:
    """Return the serial ports of this machine, sorted by path; ptys and URLs are not among them."""
    machine = Machine()
    found = _devices(machine)
    held = machine.held(*found) if found else {}
    return sorted(
        PortInfo(
            path=path,
            description="" if port.description == "n/a" else port.description or "",
            hardware_id="" if port.hwid == "n/a" else port.hwid or "",
            likely=port.vid is not None,
            usb="" if port.vid is None else f"{port.vid:04x}:{port.pid or 0:04x}",
            serial_number=port.serial_number or "",
            by_id=machine.by_id(path),
            driver=machine.driver(path),
            latency_ms=machine.latency_timer(path),
            holders=held[path].holders,
            unseen=held[path].unseen,
        )
        for path, port in found.items()
    )


def _devices(machine: Machine) -> dict[str, Any]:
    """What pyserial tells of each serial port, by its path."""
    from serial.tools import list_ports as serial_ports  # which takes 10 ms to load

    found = serial_ports.comports()
    return {port.device: port for port in found if not machine.no_hardware(port.device)}


def paths_here() -> list[str]:
    """Return the paths of the serial ports of this machine; looks into no process."""
    try:
        return sorted(_devices(Machine()))
    except (OSError, TypeError, ValueError):  # an adapter was unplugged while its files were read
        return []


def same_line(one: str, other: str) -> bool:
    """Whether two names of ports mean the same line, also through a symbolic link."""
    return Machine().device(one) == Machine().device(other)


def _usb(folder: Path) -> UsbDevice | None:
    vendor = _text(folder / "idVendor")
    if not vendor:
        return None
    says = (one_line(_text(folder / name)) for name in ("idProduct", "serial", "product"))
    return UsbDevice(folder, one_line(vendor), *says)


def _text(path: Path) -> str:
    """The text of a small file without the blanks around it; "" if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except (OSError, ValueError):  # ValueError: a name with a NUL
        return ""


def _number(text: str) -> int | None:
    """The number that a file or its name says, None for anything else."""
    return int(text) if re.fullmatch("[0-9]{1,18}", text) else None


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:
        return ""


def _named(entry: Callable[[int], Any], number: int) -> str:
    """The name of a user or a group, its number where it has none."""
    try:
        return str(entry(number)[0])
    except KeyError:
        return str(number)
