"""Turns errors of ports into LinkErrors: one sentence that says what happened and what to do."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from shlex import quote
from urllib.parse import urlsplit

from bilprov.analyzer.transport.machine import Held, Machine, Process
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
# Error numbers that get the same sentence as another number.
_SAME_AS = {
    errno.EPERM: errno.EACCES,
    errno.EAGAIN: errno.EBUSY,  # flock: another program holds the lock
    errno.ENXIO: errno.EIO,
    errno.ENODEV: errno.EIO,
    errno.ENOTDIR: errno.ENOENT,
    errno.ETIMEDOUT: errno.EHOSTUNREACH,
    errno.ENETUNREACH: errno.EHOSTUNREACH,
    errno.EPIPE: errno.ECONNRESET,
    errno.ENOTCONN: errno.ECONNRESET,
    errno.ECONNABORTED: errno.ECONNRESET,
}


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
    owner = machine.owner(name)
    device = quote(machine.device(name))
    if owner is None or not owner.group_may or owner.group == "root":
        whose = f"it belongs to {owner.user} alone" if owner else "its owner cannot be seen"
        return LinkError(
            f"permission to open {name} is denied: {whose}; until it is plugged in again this "
            "lets everybody",
            f"sudo chmod a+rw {device}",
        )
    belongs = f"it belongs to {owner.user} and the group {owner.group}"
    if machine.is_member(owner.group):
        return LinkError(
            f"permission to open {name} is denied: {belongs}, which you have joined after this "
            "session began; log in again, or begin a shell that knows it",
            f"newgrp {quote(owner.group)}",
        )
    return LinkError(
        f"permission to open {name} is denied: {belongs}; join the group, then log in again",
        f"sudo usermod -aG {quote(owner.group)} $USER",
    )


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
    sentence = f"{name} is in use by another program, {holder}{more}; close it there, or end it"
    return LinkError(sentence, _ending(holder, name, machine))


def _ending(holder: Process, name: str, machine: Machine) -> str:
    """The kindest command that ends a process for good: what is started anew, by its service."""
    service = {
        "ModemManager": "ModemManager.service",
        "agetty": f"serial-getty@{machine.title(name)}.service",
    }.get(holder.name)
    if service:
        return f"sudo systemctl stop {service}"
    return f"{'' if machine.is_own(holder.pid) else 'sudo '}kill {holder.pid}"


# What is said with the help of the machine: who holds the port, whose it is, what else there is.
_EXPLAINED: dict[int, Callable[[str, Sequence[str], Machine], LinkError]] = {
    errno.ENOENT: missing,
    errno.EACCES: lambda name, _, machine: denied(name, machine),
    errno.EBUSY: lambda name, _, machine: busy(name, machine.held(name)[name], machine),
}


def opening_failed(
    name: str, error: BaseException, settings: str, ports_here: Sequence[str]
) -> LinkError:
    """Return a LinkError that says why `name` could not be opened.

    `settings` is the line as text, like `115200 8N1`; `ports_here` are the paths that could be
    opened instead. pyserial often drops the error number, so the whole chain of causes is searched.
    """
    chain = list(_causes(error))
    number = _number(chain)
    path = path_in(name)
    if number in _EXPLAINED and path is not None:
        return _EXPLAINED[number](path, ports_here, Machine())
    if number in (errno.EIO, errno.EAGAIN) and "://" in name and not _is_wrapped_path(name):
        number = errno.EHOSTUNREACH
    if number is None and isinstance(chain[-1], TimeoutError):
        number = errno.EHOSTUNREACH
    sentence = _OPENING.get(number or 0)
    if sentence is None:
        return LinkError(f"{name} cannot be opened: {_reason(chain[-1])}; see `bilprov ports`")
    address = urlsplit(name).netloc if "://" in name else name
    return LinkError(sentence.format(name=name, settings=settings, address=address))


def link_lost(name: str, error: BaseException) -> LinkError:
    """Return a LinkError that says why the open port `name` can no longer be used."""
    chain = list(_causes(error))
    number = _number(chain)
    if number == errno.EIO and "://" in name and not _is_wrapped_path(name):
        number = errno.ECONNRESET
    sentence = _LOSING.get(number or 0)
    if sentence is None:
        return LinkError(f"{name} failed while it was in use: {_reason(chain[-1])}")
    return LinkError(sentence.format(name=name))


def writing_failed(name: str, error: BaseException, timeout: float) -> LinkError:
    """Return a LinkError that says why a write to `name` failed; `timeout` (s) was its limit.

    pyserial's error for a write time-out is its only one without an error number.
    """
    if _number(list(_causes(error))) is not None:
        return link_lost(name, error)
    return LinkError(f"{name} took no byte for {timeout:g} s; does anything read at the other end?")


def echo_differs(name: str, sent: bytes, came: bytes) -> LinkError:
    """Return a LinkError that says that something else came than the echo of what was sent."""
    return LinkError(
        f"{name} carried {first_bytes(came)} where {first_bytes(sent)} was sent: another sender "
        "talked at the same time, or this line has no echo"
    )


def echo_missing(name: str, sent: bytes, came: bytes, timeout: float) -> LinkError:
    """Return a LinkError that says how much of the echo came in `timeout` s."""
    return LinkError(
        f"{len(came)} of the {len(sent)} bytes {first_bytes(sent)} came back from {name} in "
        f"{timeout:g} s: is the adapter connected, and does the line have an echo?"
    )


def first_bytes(data: bytes) -> str:
    """The first bytes in hex."""
    return data[:_SHOWN].hex(" ") + (" ..." if len(data) > _SHOWN else "")


def path_in(name: str) -> str | None:
    """Return the path in the name of a port, None for a URL of something else than a path."""
    scheme, colon, rest = name.partition("://")
    if not colon:
        return name
    return rest.partition("?")[0] if scheme.lower() in ("spy", "alt") else None


def _is_wrapped_path(name: str) -> bool:
    return name.lower().startswith(("spy://", "alt://", "hwgrep://"))


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def _number(chain: Sequence[BaseException]) -> int | None:
    """Return the first error number in the chain; termios.error has it in `args` only."""
    for error in chain:
        found = error.args[0] if error.args else None
        if isinstance(found, int) and found > 0:  # getaddrinfo's numbers are negative
            return _SAME_AS.get(found, found)
    return None


def _reason(error: BaseException) -> str:
    """Return the message of the system's error, without its number."""
    said = error.args[-1] if error.args else ""
    if isinstance(error, OSError) and error.strerror:
        said = error.strerror
    return str(said) or type(error).__name__
