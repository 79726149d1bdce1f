"""Opens ports: non-blocking reads, complete writes, error counts. Every fault is a LinkError.

And a pseudo terminal (pty) in raw mode, which a host program opens as its port, and its openings.
At a port that raises DTR an opening resets an Arduino. The only module that uses pyserial to open.
"""

from __future__ import annotations

import array
import contextlib
import ctypes
import errno
import fcntl
import os
import queue
import select
import socket
import termios
import threading
import time
import tty
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import serial

from bilprov.analyzer.transport.errors import (
    LinkError,
    first_bytes,
    link_lost,
    opening_failed,
    writing_failed,
)
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.machine import Machine
from bilprov.captures.closing import Closing

WRITE_TIMEOUT = 1.0  # s without a single byte taken
ECHO_TIMEOUT = 0.5  # s that an echo may come late
_READ_LIMIT = 1 << 16  # bytes in one read(), so that a flood cannot hold the caller
_MORE_COMES = 2048  # bytes: a shorter read has emptied a terminal's or a socket's buffer
_PULSE = 0.01  # s
_TIOCGICOUNT = 0x545D
# Places in Linux's struct serial_icounter_struct: cts dsr rng dcd rx tx frame overrun parity brk
# buf_overrun, then room for more.
_COUNTERS = {"parity": (8,), "framing": (6,), "overrun": (7, 10), "break": (9,)}
# What pyserial's open ports raise. loop:// lets queue.Full through.
FAULTS = (OSError, termios.error, ValueError, TypeError, queue.Full)


class Port(Closing):
    """An open port, made by `open_port`. Every fault of the port is raised as a LinkError."""

    def __init__(self, name: str, settings: LineSettings, handle: Any) -> None:
        self.name = name
        self.settings = settings
        self._handle = handle
        self._unechoed = bytearray()
        self._instant = "://" in name or Machine().is_pty(name)
        # spy:// prints the traffic, so its bytes have to go through pyserial's own calls.
        self._spied = name.lower().startswith("spy://")
        self._pump: _Pump | None = None
        try:
            self._fd = int(handle.fileno())
        except OSError:  # io.UnsupportedOperation
            self._pump = _Pump(handle)
            self._fd = self._pump.fileno()

    def fileno(self) -> int:
        """Return the descriptor for select. Raises LinkError when the port is closed."""
        self._require_open()
        return self._fd

    @property
    def byte_time(self) -> int:
        """The time, in ns, that each written byte takes until it is sent: a UART sends serially.

        It is 0 for a pty or a socket, where written bytes have arrived.
        """
        return 0 if self._instant else self.settings.byte_time

    def read(self, *, ready: bool = False) -> bytes:
        """Return the available bytes, at most 64 KiB, without waiting; b"" if there are none now.

        `ready` is true if `select` has just found the port readable. Raises LinkError at the end
        of the line (unplugged, closed by the other side), but only after all bytes that came before
        the end have been returned.
        """
        self._require_open()
        taken = b""
        while len(taken) < _READ_LIMIT:
            try:
                data = self._take(ready and not taken)
            except FAULTS as error:
                if taken:  # return these bytes first; the next read meets the same fault again
                    break
                raise link_lost(self.name, error) from error
            taken += data
            if len(data) < _MORE_COMES:
                break
        return taken

    def write_some(self, data: bytes | memoryview) -> int:
        """Write as many bytes as the port takes without waiting, and return their number.

        loop://, rfc2217:// and spy:// take up to 1 KiB and may wait as long as `write` does. Raises
        LinkError.
        """
        self._require_open()
        try:
            if not (self._spied or self._pump):
                return os.write(self._fd, data)
            part = bytes(data[:1024])
            self._handle.write(part)
        except BlockingIOError:
            return 0
        except FAULTS as error:
            raise writing_failed(self.name, error, WRITE_TIMEOUT) from error
        return len(part)

    def write(self, data: bytes) -> None:
        """Write all of `data`, and take away its echo where the line has one.

        Raises LinkError when the port is lost or takes no byte for 1 s (pyserial's own write gives
        up when the buffer is exactly full although all was taken, and spins while it waits), and
        where the echo differs or does not come.
        """
        try:
            self._write_all(data)
            self._take_echo()
        finally:
            self._unechoed.clear()

    def error_counts(self) -> Mapping[str, int] | None:
        """Return the driver's counts of `parity`, `framing`, `overrun` and `break` errors.

        None where there are no such counts (pty, sockets, some adapters). pyserial clears INPCK and
        IGNBRK, so a parity error passes as a byte and a break as 0x00: only the counts show them.
        """
        self._require_open()
        buffer = array.array("i", [0] * 20)
        try:
            fcntl.ioctl(self._fd, _TIOCGICOUNT, buffer)
        except OSError:
            return None
        return {name: sum(buffer[at] for at in places) for name, places in _COUNTERS.items()}

    def modem_line(self, line: str) -> bool | None:
        """Return whether `cts`, `dsr`, `dcd` or `ri` is asserted; None where there is no such line.

        Raises LinkError when the port is closed.
        """
        self._require_open()
        try:
            return bool(getattr(self._handle, {"dcd": "cd"}.get(line, line)))
        except (*FAULTS, NotImplementedError, AttributeError):
            return None  # pyserial's ways to say that this kind of URL has no such line

    def pulse_dtr(self) -> None:
        """Drop DTR for 10 ms, as if the port were opened anew: that resets an Arduino.

        A pty has no such line and is opened a second time instead, which `Openings` notices. What
        has neither is left alone. Raises LinkError when the port is closed.
        """
        self._require_open()
        with contextlib.suppress(*FAULTS):
            if Machine().is_pty(self.name):
                os.close(os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
            else:
                self._handle.dtr = False
                time.sleep(_PULSE)
                self._handle.dtr = True

    def renew(self, other: Port) -> None:
        """Go on as another open port, which was opened in place of this one; this one is closed."""
        self.close()
        vars(self).update(vars(other))

    def close(self) -> None:
        """Close the port. Never raises; further calls do nothing."""
        sock = getattr(self._handle, "_socket", None)
        if sock and self._pump is None:
            # socket:// would sleep 0.3 s, and leaks the socket when the other side went first.
            self._handle._socket = None
            self._handle.is_open = False
        with contextlib.suppress(Exception):
            self._handle.close()
        if sock:
            sock.close()
        if self._pump is not None:
            self._pump.close()

    def __repr__(self) -> str:
        return f"<Port {self.name} {self.settings}>"

    def _write_all(self, data: bytes) -> None:
        left = memoryview(data)
        give_up = time.monotonic() + WRITE_TIMEOUT
        while left:
            count = self.write_some(left)
            if self.settings.echo:
                self._unechoed += left[:count]
            left = left[count:]
            now = time.monotonic()
            if count:
                give_up = now + WRITE_TIMEOUT
            elif now >= give_up:
                raise writing_failed(self.name, TimeoutError(), WRITE_TIMEOUT)
            else:
                # Waits are short, since a UART reports room long after it could take some bytes.
                select.select([], [self._fd], [], 0.02)

    def _take_echo(self) -> None:
        """Read the echo of all that was written, also by a signal handler meanwhile."""
        sent, came = bytes(self._unechoed), b""
        give_up = time.monotonic() + len(sent) * self.byte_time / 1e9 + ECHO_TIMEOUT
        while self._unechoed:
            try:
                part = self._take(False, len(self._unechoed))
            except FAULTS as error:
                raise link_lost(self.name, error) from error
            came += part
            if not self._unechoed.startswith(part):
                raise LinkError(
                    f"{self.name} carried {first_bytes(came)} where {first_bytes(sent)} was sent: "
                    "another sender talked at the same time, or this line has no echo"
                )
            del self._unechoed[: len(part)]
            if not part and time.monotonic() >= give_up:
                raise LinkError(
                    f"{len(came)} of the {len(sent)} bytes {first_bytes(sent)} came back from "
                    f"{self.name} in {ECHO_TIMEOUT:g} s: is the adapter connected, and does the "
                    "line have an echo?"
                )
            if not part:
                select.select([self._fd], [], [], 0.02)

    def _take(self, ready: bool, most: int = _READ_LIMIT) -> bytes:
        if self._spied:
            return bytes(self._handle.read(most))
        if not ready and not select.select([self._fd], [], [], 0)[0]:
            return b""
        try:
            data = os.read(self._fd, most)
        except BlockingIOError:
            return b""
        if not data:  # readable, yet nothing comes: unplugged
            raise OSError(errno.EIO, "end of the line")
        return data

    def _require_open(self) -> None:
        if not self._handle.is_open:
            raise LinkError(f"{self.name} is closed")


def open_port(name: str, settings: LineSettings | None = None) -> Port:
    """Open a path or a pyserial URL (`socket://HOST:PORT`, `rfc2217://`, `loop://`, `spy://PATH`).

    The port is in raw mode with 8 bits, no flow control, and non-blocking. A path is locked
    (advisory lock). pyserial raises DTR and RTS, which resets an Arduino. `settings` are the
    built-in grammar's unless given; they have no effect on `socket://`. Raises LinkError.
    """
    if settings is None:
        from bilprov.analyzer.grammar_file import load_protocol

        settings = line_settings(load_protocol())
    _require_address(name)
    try:
        with warnings.catch_warnings():
            # pyserial's rfc2217 names its thread in a deprecated way.
            warnings.simplefilter("ignore", DeprecationWarning)
            handle: Any = serial.serial_for_url(
                name,
                baudrate=settings.baud,
                # A pty has no parity: asked for it again, the kernel refuses it.
                parity="N" if Machine().is_pty(name) else settings.parity,
                stopbits=settings.stopbits,
                timeout=0,
                # rfc2217 knows no write time-out; its socket has one (below).
                write_timeout=None if name.lower().startswith("rfc2217:") else WRITE_TIMEOUT,
                exclusive=True,
            )
    except Exception as error:  # URL handlers raise any type of error (KeyError, TypeError)
        raise opening_failed(name, error, str(settings)) from error
    port = Port(name, settings, handle)
    try:
        sock = getattr(handle, "_socket", None)
        if sock is not None:
            # Without this option bytes that follow an answer arrive up to 43 ms late, in pieces.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.settimeout(WRITE_TIMEOUT)
        elif os.isatty(port.fileno()):
            # pyserial leaves BRKINT unchanged: with it a break discards pending input.
            attributes = termios.tcgetattr(port.fileno())
            if attributes[0] & termios.BRKINT:
                attributes[0] &= ~termios.BRKINT
                termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)
    except FAULTS as error:
        port.close()
        raise opening_failed(name, error, str(settings)) from error
    return port


def _require_address(name: str) -> None:
    """Raise LinkError for a network URL without host and port; pyserial's message is unclear."""
    if not name.lower().startswith(("socket://", "rfc2217://")):
        return
    try:
        parts = urlsplit(name)
        complete = bool(parts.hostname) and parts.port is not None
    except ValueError:  # a port that is no number, or too large
        complete = False
    if not complete:
        raise LinkError(
            f"{name} is not a usable address; write it like {name.split('://')[0]}://127.0.0.1:5000"
        )


class _Pump(Closing):
    """Copies what a URL handler without a descriptor (loop, rfc2217) has read to one for select.

    Such a handler puts each byte into a queue, and None at the end; not where its thread fails.
    """

    def __init__(self, handle: Any) -> None:
        self._came = handle.queue if hasattr(handle, "queue") else handle._read_buffer
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)  # others may take what select has found
        self.fileno = self._reader.fileno
        threading.Thread(target=self._copy, daemon=True).start()
        if thread := getattr(handle, "_thread", None):
            threading.Thread(target=self._mark_end, args=(thread,), daemon=True).start()

    def _copy(self) -> None:
        with self._writer, contextlib.suppress(OSError):  # closed at the other end
            while byte := self._came.get():
                self._writer.sendall(byte)

    def _mark_end(self, thread: threading.Thread) -> None:
        thread.join()
        self._came.put(None)

    def close(self) -> None:
        """End the copying; further calls do nothing."""
        self._reader.close()
        with contextlib.suppress(queue.Full):
            self._came.put_nowait(None)


class PtyPair(Closing):
    """Both ends of a pty: `master` is our descriptor (non-blocking), `name` the path for others.

    The pair keeps the slave open, so that the master never gets EIO when the last program closes
    the path. Unread bytes wait in the kernel (at least 4 KiB), as in a driver's buffer.
    """

    def __init__(self, master: int, slave: int) -> None:
        self.master = master
        self.name = os.ttyname(slave)
        self._descriptors = [master, slave]

    def fileno(self) -> int:
        """Return our descriptor, for select."""
        return self.master

    def read(self) -> bytes:
        """Return what the program at the path has written, at most 64 KiB, without waiting."""
        taken = bytearray()
        with contextlib.suppress(BlockingIOError):
            while len(taken) < _READ_LIMIT:
                taken += os.read(self.master, _READ_LIMIT)
        return bytes(taken)

    def write_some(self, data: bytes) -> int:
        """Write without waiting and return how many bytes were taken: 0 when the pty is full."""
        try:
            return os.write(self.master, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close both ends; a program that has the path open sees an unplugged port."""
        while self._descriptors:
            with contextlib.suppress(OSError):
                os.close(self._descriptors.pop())


def open_pty() -> PtyPair:
    """Return a new pty in raw mode: 8 bits, no echo, no signals, no flow control.

    A new pty is in cooked mode, where 0x03 would come back as "^C" and 0x11 would be XON.
    Raises LinkError if the system has no pty left.
    """
    try:
        master, slave = os.openpty()
    except OSError as error:
        raise LinkError(
            f"this machine gives no pty: {error.strerror}; close a program that holds some"
        ) from error
    tty.setraw(slave)
    os.set_blocking(master, False)
    return PtyPair(master, slave)


_IN_OPEN = 0x20  # of Linux's inotify: a file was opened
_EVENTS = 1 << 12  # bytes of events in one read()


class Openings(Closing):
    """The openings of a path from now on.

    One of its `descriptors` is readable once there is one. There is none on a system without
    inotify, or where this user watches too much already: then no opening is noticed.
    """

    def __init__(self, path: str) -> None:
        self.descriptors: list[int] = []
        libc = ctypes.CDLL(None)
        found = libc.inotify_init1(os.O_NONBLOCK) if hasattr(libc, "inotify_init1") else -1
        if found >= 0:
            self.descriptors = [found]
            libc.inotify_add_watch(found, path.encode(), _IN_OPEN)

    def taken(self) -> bool:
        """Return whether the path was opened since this was last asked."""
        found = False
        for descriptor in self.descriptors:
            with contextlib.suppress(BlockingIOError):
                while os.read(descriptor, _EVENTS):
                    found = True
        return found

    def close(self) -> None:
        """Watch no longer; further calls do nothing."""
        while self.descriptors:
            os.close(self.descriptors.pop())


_BACKLOG_LIMIT = 1 << 16  # bytes
_STUCK_AFTER = 1_000_000_000  # ns without a byte taken


@dataclass(eq=False)
class Forward:
    """A bounded queue of bytes for a peer: at most 64 KiB, and 1 s for a peer that takes nothing.

    What exceeds these limits is dropped, since old bytes would only confuse a program that starts
    to read later. `write_some` writes without waiting and returns the number of bytes taken;
    `complaint` says in words what it means when it takes none.
    """

    write_some: Callable[[bytes], int]
    complaint: str
    _backlog: bytearray = field(default_factory=bytearray)
    _taken_at: int = 0  # ns: when the peer last took bytes, or none were waiting
    _stuck: bool = False  # the peer took nothing for too long, and nothing since then
    _told: bool = False

    @property
    def owed(self) -> bool:
        """Whether bytes wait that the peer has not taken yet."""
        return bool(self._backlog)

    def push(self, data: bytes, now: int) -> str:
        """Forward the waiting bytes and `data` at `now` (ns); return a sentence if some are lost.

        Otherwise return "". There is one sentence each time a peer falls behind, not one per drop.
        """
        if not self._backlog:
            self._taken_at = now
        self._backlog += data
        complaint, count = self.complaint, 0
        try:
            count = self.write_some(bytes(self._backlog)) if self._backlog else 0
        except LinkError as error:  # the peer will take nothing any more
            complaint, self._stuck = str(error), True
        if count:
            del self._backlog[:count]
            self._taken_at, self._stuck = now, False
        if not self._backlog:
            self._told = self._told and not count
            return ""
        self._stuck = self._stuck or now - self._taken_at >= _STUCK_AFTER
        dropped = len(self._backlog) - (0 if self._stuck else _BACKLOG_LIMIT)
        if dropped <= 0:
            return ""
        del self._backlog[-dropped:]
        told, self._told = self._told, True
        return "" if told else f"{complaint}; {dropped} bytes or more were not handed on"
