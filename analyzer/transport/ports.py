"""Lists ports and opens them. The only module that uses pyserial."""

from __future__ import annotations

import os
import socket
import termios
import warnings
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports as serial_list_ports

from bilprov.analyzer.transport.errors import LinkError, opening_failed
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.machine import Machine, Process
from bilprov.analyzer.transport.port import FAULTS, WRITE_TIMEOUT, Port, is_pty


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
                parity="N" if is_pty(name) else settings.parity,
                stopbits=settings.stopbits,
                timeout=0,
                # rfc2217 knows no write time-out; its socket has one (below).
                write_timeout=None if name.lower().startswith("rfc2217:") else WRITE_TIMEOUT,
                exclusive=True,
            )
    except Exception as error:  # URL handlers raise any type of error (KeyError, TypeError)
        raise opening_failed(name, error, str(settings), paths_here()) from error
    port = Port(name, settings, handle)
    try:
        sock = getattr(handle, "_socket", None)
        if sock is not None:
            # Without this option bytes that follow an answer arrive up to 43 ms late, in pieces.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.settimeout(WRITE_TIMEOUT)
        elif os.isatty(port.fileno()):
            _ignore_break_signal(port.fileno())
    except FAULTS as error:
        port.close()
        raise opening_failed(name, error, str(settings), paths_here()) from error
    return port


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
    found = serial_list_ports.comports()
    return {port.device: port for port in found if not machine.no_hardware(port.device)}


def paths_here() -> list[str]:
    """Return the paths of the serial ports of this machine; looks into no process."""
    try:
        return sorted(_devices(Machine()))
    except (OSError, TypeError, ValueError):  # an adapter was unplugged while its files were read
        return []


def same_line(one: str, other: str) -> bool:
    """Whether two names of ports mean the same line, also through a symbolic link."""
    if one == other:
        return True
    return "://" not in one + other and os.path.realpath(one) == os.path.realpath(other)


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


def _ignore_break_signal(fd: int) -> None:
    """Clear BRKINT, which pyserial leaves unchanged: with it a break discards pending input."""
    attributes = termios.tcgetattr(fd)
    if attributes[0] & termios.BRKINT:
        attributes[0] &= ~termios.BRKINT
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
