"""Checks of what the system says of a port before it is opened; each is a row of `CHECKS`."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from shlex import quote

from bilprov.analyzer.doctor.finding import Finding, Grade, refused
from bilprov.analyzer.transport.errors import (
    NO_BRAILLE,
    busy,
    denied,
    missing,
    opening_failed,
    path_in,
)
from bilprov.analyzer.transport.machine import MODEM_MANAGER, Held, Machine, for_braille

LATENCY_LIMIT = 4
"""Ms for which an adapter may hold bytes back before that is worth a word; FTDI's are set to 16."""

_IGNORED_BY_MODEM_MANAGER = ("ID_MM_DEVICE_IGNORE", "ID_MM_PORT_IGNORE")
_RULES = "/etc/udev/rules.d/78-bilprov.rules"


@dataclass(frozen=True, slots=True)
class Subject:
    """The port that is examined: its name, the machine, the ports there are, who holds it."""

    name: str
    machine: Machine
    ports_here: Sequence[str]
    held: Held

    @property
    def device(self) -> str:
        """The path of its device, quoted for a shell."""
        return quote(self.machine.device(self.name))


def subject(name: str, machine: Machine, ports_here: Sequence[str]) -> Subject:
    """The port of that name as the machine has it now."""
    return Subject(name, machine, ports_here, machine.held(name)[name])


def _there(port: Subject) -> Finding | None:
    if port.name and port.machine.file(port.machine.device(port.name)).exists():
        return None
    return refused("there", missing(port.name, port.ports_here, port.machine))


def _terminal(port: Subject) -> Finding | None:
    if port.machine.is_terminal(port.name):
        return None
    folder = port.machine.file(port.machine.device(port.name)).is_dir()
    error = OSError(errno.EISDIR if folder else errno.ENOTTY, "")
    return refused("serial port", opening_failed(port.name, error, "", ()))


def _permission(port: Subject) -> Finding:
    if not port.machine.may_open(port.name):
        return refused("permission", denied(port.name, port.machine))
    return Finding("permission", Grade.FINE, "you may open it")


def _holder(port: Subject) -> Finding:
    if port.held.holders:
        return refused("holder", busy(port.name, port.held, port.machine))
    if port.held.unseen:
        many = "process is" if port.held.unseen == 1 else "processes are"
        sentence = (
            f"none of your programs holds it; {port.held.unseen} {many} other users' and cannot be "
            "looked into; this names all who hold it"
        )
        return Finding("holder", Grade.UNSEEN, sentence, f"sudo fuser -v {port.device}")
    return Finding("holder", Grade.FINE, "nobody else holds it")


def _lock_file(port: Subject) -> Finding | None:
    lock = port.machine.lock_file(port.name)
    if lock is None or port.machine.is_running(lock[1]):
        return None
    sentence = (
        f"{lock[0]} was left by a program that has ended (pid {lock[1]}), and makes some others "
        "believe that the port is in use"
    )
    return Finding("lock file", Grade.ADVICE, sentence, f"sudo rm {quote(lock[0])}")


def _pty(port: Subject) -> Finding | None:
    if not port.machine.is_pty(port.name):
        return None
    server = f", served by {port.held.server}" if port.held.server else ""
    sentence = f"a pseudo terminal{server}: it has no baud rate, no parity and no modem lines"
    return Finding("pty", Grade.FINE, sentence)


def _modem_manager(port: Subject) -> Finding | None:
    usb = port.machine.usb(port.name)
    if usb is None:
        return None
    says = port.machine.properties(port.name)
    ignored = any(says.get(tag, "0") != "0" for tag in _IGNORED_BY_MODEM_MANAGER)
    if ignored or not port.machine.running(MODEM_MANAGER):
        return Finding("ModemManager", Grade.FINE, "ModemManager leaves it alone")
    sentence = (
        f"ModemManager is running, has no rule to leave {port.name} alone, and may send it modem "
        "commands, which a robot takes for instructions"
    )
    rule = (
        f'ATTRS{{idVendor}}=="{usb.vendor}", ATTRS{{idProduct}}=="{usb.product}", '
        'ENV{ID_MM_DEVICE_IGNORE}="1"'
    )
    command = (
        f"echo {quote(rule)} | sudo tee -a {_RULES} && sudo udevadm control --reload && "
        "sudo udevadm trigger"
    )
    return Finding("ModemManager", Grade.ADVICE, sentence, command)


def _brltty(port: Subject) -> Finding | None:
    if not for_braille(port.machine.properties(port.name)):
        return None
    sentence = (
        f"udev's rules take {port.name} for a Braille display, and brltty may take it away at any "
        "moment; where nobody needs one, end it"
    )
    return Finding("brltty", Grade.ADVICE, sentence, NO_BRAILLE)


def _latency_timer(port: Subject) -> Finding | None:
    milliseconds = port.machine.latency_timer(port.name)
    if milliseconds is None:
        return None
    if milliseconds <= LATENCY_LIMIT:
        sentence = f"its adapter holds bytes back for at most {milliseconds} ms"
        return Finding("latency timer", Grade.FINE, sentence)
    sentence = (
        f"the adapter of {port.name} holds bytes back for up to {milliseconds} ms, so times of "
        "answers are that uncertain"
    )
    file = quote(f"/sys/bus/usb-serial/devices/{port.machine.title(port.name)}/latency_timer")
    return Finding("latency timer", Grade.ADVICE, sentence, f"echo 1 | sudo tee {file}")


FIRST = (_there, _terminal)
"""The checks after which no others are made where their finding blocks."""

CHECKS = (
    *FIRST,
    _pty,
    _permission,
    _holder,
    _lock_file,
    _modem_manager,
    _brltty,
    _latency_timer,
)


def _shared(port: Subject) -> Finding | None:
    if not port.held.holders:
        return None
    error = busy(port.name, port.held, port.machine)
    sentence = f"{error.sentence}, since each of the two loses what the other reads"
    return Finding("holder", Grade.ADVICE, sentence, error.command)


# What is worth a word where a port was opened all the same.
_IN_USE = (_shared, _modem_manager, _brltty, _latency_timer)


def examined(port: Subject) -> Iterator[Finding]:
    """Make every check of a port, in their order; nothing is opened or changed."""
    for check in CHECKS:
        finding = check(port)
        if finding is not None:
            yield finding
            if check in FIRST and finding.grade is Grade.BLOCKS:
                return


def notes(name: str, machine: Machine | None = None) -> list[str]:
    """What a command that uses the port should tell its user, a line each.

    Only the port of a USB adapter or board has any; nothing else is looked at for other ports.
    """
    machine = machine or Machine()
    path = path_in(name)
    if path is None or machine.usb(path) is None:
        return []
    port = subject(path, machine, ())
    findings = (look(port) for look in _IN_USE)
    return [one.note(path) for one in findings if one and one.grade is Grade.ADVICE]
