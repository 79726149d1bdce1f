"""Turns errors of ports into LinkErrors: one sentence that says what happened and what to do."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from shlex import quote
from urllib.parse import urlsplit

from bilprov.analyzer.transport.machine import Held, Machine, paths_here
from bilprov.captures.text import near
from bilprov.spec.errors import UserError, one_line

SIM = "sim"  # a target that is no port

_OPENING = {
    errno.EISDIR: "{name} is a folder, not a serial port; see `bilprov ports`",
    errno.ENOTTY: "{name} is not a serial port; see `bilprov ports`",
    errno.EIO: "{name} has a name here but no device behind it; plug it in, or see `bilprov ports`",
    errno.EINVAL: "{name} does not accept {settings}; try other line settings",
    errno.ECONNREFUSED: (
        "nobody listens at {address} ({name}); is the program that serves it running?"
    ),
    errno.EHOSTUNREACH: (
        "{address} does not answer ({name}); check the host, the port and the network"
    ),
}
_LOSING = {
    errno.EIO: "{name} disappeared while it was in use; plug it in again",
    errno.ECONNRESET: "{name} was closed by the other side; is the program that serves it running?",
}
# Error numbers that get the sentence of the first in their row.
_ALIKE = (
    (errno.EACCES, errno.EPERM),
    (errno.EBUSY, errno.EAGAIN),  # flock: another program holds the lock
    (errno.EIO, errno.ENXIO, errno.ENODEV),
    (errno.ENOENT, errno.ENOTDIR),
    (errno.EHOSTUNREACH, errno.ETIMEDOUT, errno.ENETUNREACH),
    (errno.ECONNRESET, errno.EPIPE, errno.ENOTCONN, errno.ECONNABORTED),
)
_SAME_AS = {number: numbers[0] for numbers in _ALIKE for number in numbers}
_SHOWN = 16  # bytes that a sentence lists
_NEAR = 0.85  # how alike two names are, of 1, where one may be meant by the other


class LinkError(UserError):
    """A port cannot be opened, read or written. The message is one sentence for the user.

    `sentence` is the message without the `command` that mends it, "" where there is none.
    """

    def __init__(self, sentence: str, command: str = "") -> None:
        super().__init__(f"{sentence}: {command}" if command else sentence)
        self.sentence, self.command = one_line(sentence), one_line(command)


def missing(name: str, ports_here: Sequence[str], machine: Machine) -> LinkError:
    """Return a LinkError that says that there is no such port, and which there are."""
    if name == SIM:
        return LinkError(
            "sim is not a port: it is the simulator of conform sim, send sim and sniff sim; "
            "`bilprov simulate` serves one at a port, whose name it prints"
        )
    name = name or "port ''"
    usb = machine.taken_for_braille()
    if usb:
        return LinkError(
            f"there is no {name}; brltty has taken the adapter {usb.identity} {usb.title} for a "
            "Braille display: where nobody needs one, end it and plug the adapter in again",
            "sudo systemctl mask --now brltty.service brltty-udev.service",  # udev starts it anew
        )
    if re.fullmatch(r"(tcp:)?[\w.-]*\w:\d+", name):
        address = name.removeprefix("tcp:")
        return LinkError(
            f"{name} is not a port of this machine; did you mean socket://{address}, a device that "
            "is served over TCP?"
        )
    titles = {Path(path).name: path for path in ports_here}
    meant = near(Path(name).name, titles, _NEAR)
    advice = f"did you mean {titles[meant]}?" if meant else "see `bilprov ports`"
    listed = ", ".join(ports_here) or "none"
    return LinkError(f"there is no {name}; ports here: {listed}; {advice}")


def denied(name: str, machine: Machine) -> LinkError:
    """Return a LinkError that says who may open the port, and the command that lets you."""
    owner, device = machine.owner(name), quote(machine.device(name))
    if owner is None or not owner.group_may or owner.group == "root":
        whose = f"it belongs to {owner.user} alone" if owner else "its owner cannot be seen"
        advice = "until it is plugged in again this lets everybody"
        command = f"sudo chmod a+rw {device}"
    else:
        whose = f"it belongs to {owner.user} and the group {owner.group}"
        advice = "join the group, then log in again"
        command = f"sudo usermod -aG {quote(owner.group)} $USER"
        if machine.is_member(owner.group):
            whose += ", which you have joined after this session began"
            advice = "log in again, or begin a shell that knows it"
            command = f"newgrp {quote(owner.group)}"
    return LinkError(f"permission to open {name} is denied: {whose}; {advice}", command)


def busy(name: str, held: Held, machine: Machine) -> LinkError:
    """Return a LinkError that says who holds the port, and the command that ends it."""
    if not held.holders and held.own:
        return LinkError(f"{name} is open in this program already; a port is opened once")
    if not held.holders:
        return LinkError(
            f"{name} is in use by another program, which this user may not see; this names it",
            f"sudo fuser -v {quote(machine.device(name))}",
        )
    holder = held.holders[0]
    more = f" and {len(held.holders) - 1} more" if len(held.holders) > 1 else ""
    # The kindest command that ends it for good: what is started anew, by its service.
    service = {
        "ModemManager": "ModemManager.service",
        "agetty": f"serial-getty@{machine.title(name)}.service",
    }.get(holder.name)
    sudo = "" if machine.is_own(holder.pid) else "sudo "
    return LinkError(
        f"{name} is in use by another program, {holder}{more}; close it there, or end it",
        f"sudo systemctl stop {service}" if service else f"{sudo}kill {holder.pid}",
    )


# What is said with the help of the machine: who holds the port, whose it is, what else there is.
_EXPLAINED: dict[int, Callable[[str, Machine], LinkError]] = {
    errno.ENOENT: lambda name, machine: missing(name, paths_here(), machine),
    errno.EACCES: denied,
    errno.EBUSY: lambda name, machine: busy(name, machine.held(name)[name], machine),
}


def opening_failed(name: str, error: BaseException, settings: str) -> LinkError:
    """Return a LinkError that says why `name` could not be opened.

    `settings` is the line as text, like `115200 8N1`. pyserial often drops the error number, so the
    whole chain of causes is searched.
    """
    number, cause = _cause(error)
    path = path_in(name)
    if number in _EXPLAINED and path is not None:
        return _EXPLAINED[number](path, Machine())
    if _is_remote(name) and number in (errno.EIO, errno.EBUSY):
        number = errno.EHOSTUNREACH
    if number is None and isinstance(cause, TimeoutError):
        number = errno.EHOSTUNREACH
    sentence = _OPENING.get(number or 0)
    if sentence is None:
        return LinkError(f"{name} cannot be opened: {_reason(cause)}; see `bilprov ports`")
    address = urlsplit(name).netloc if "://" in name else name
    return LinkError(sentence.format(name=name, settings=settings, address=address))


def link_lost(name: str, error: BaseException) -> LinkError:
    """Return a LinkError that says why the open port `name` can no longer be used."""
    number, cause = _cause(error)
    if _is_remote(name) and number == errno.EIO:
        number = errno.ECONNRESET
    sentence = _LOSING.get(number or 0)
    if sentence is None:
        return LinkError(f"{name} failed while it was in use: {_reason(cause)}")
    return LinkError(sentence.format(name=name))


def writing_failed(name: str, error: BaseException, timeout: float) -> LinkError:
    """Return a LinkError that says why a write to `name` failed; `timeout` (s) was its limit.

    pyserial's error for a write time-out is its only one without an error number.
    """
    if _cause(error)[0] is not None:
        return link_lost(name, error)
    return LinkError(f"{name} took no byte for {timeout:g} s; does anything read at the other end?")


def first_bytes(data: bytes) -> str:
    """The first bytes in hex."""
    return data[:_SHOWN].hex(" ") + (" ..." if len(data) > _SHOWN else "")


def path_in(name: str) -> str | None:
    """Return the path in the name of a port, None for a URL of something else than a path."""
    scheme, colon, rest = name.partition("://")
    if not colon:
        return name
    return rest.partition("?")[0] if scheme.lower() in ("spy", "alt") else None


def _is_remote(name: str) -> bool:
    """Whether a name is a URL of something else than a path of this machine."""
    return "://" in name and not name.lower().startswith(("spy://", "alt://", "hwgrep://"))


def _cause(error: BaseException) -> tuple[int | None, BaseException]:
    """The first error number in a chain of causes, and the error with which the chain began."""
    number, cause = None, error
    chain: BaseException | None = error
    while chain is not None:
        cause, found = chain, chain.args[0] if chain.args else None  # of termios.error only there
        if number is None and isinstance(found, int) and found > 0:  # getaddrinfo's are negative
            number = _SAME_AS.get(found, found)
        chain = cause.__cause__ or cause.__context__
    return number, cause


def _reason(error: BaseException) -> str:
    """Return the message of the system's error, without its number."""
    said = error.args[-1] if error.args else ""
    if isinstance(error, OSError) and error.strerror:
        said = error.strerror
    return str(said) or type(error).__name__
