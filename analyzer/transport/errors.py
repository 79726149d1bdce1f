"""Turns errors of ports into LinkErrors: one sentence that says what happened and what to do."""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from urllib.parse import urlsplit

from bilprov.spec.errors import UserError

_OPENING = {
    errno.ENOENT: "there is no {name}; ports here: {ports}; see `bilprov ports`",
    errno.EACCES: (
        "permission to open {name} is denied; add yourself to the dialout group: "
        "sudo usermod -aG dialout $USER, then log in again"
    ),
    errno.EBUSY: "{name} is in use by another program; close it",
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
    errno.EIO: "{name} disappeared while it was in use; plug it in again and start anew",
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


class LinkError(UserError):
    """A port cannot be opened, read or written. The message is one sentence for the user."""


def opening_failed(
    name: str, error: BaseException, settings: str, ports_here: Sequence[str]
) -> LinkError:
    """Return a LinkError that says why `name` could not be opened.

    `settings` is the line as text, like `115200 8N1`; `ports_here` are the paths that could be
    opened instead. pyserial often drops the error number, so the whole chain of causes is searched.
    """
    chain = list(_causes(error))
    number = _number(chain)
    if number in (errno.EIO, errno.EAGAIN) and "://" in name and not _is_wrapped_path(name):
        number = errno.EHOSTUNREACH
    if number is None and isinstance(chain[-1], TimeoutError):
        number = errno.EHOSTUNREACH
    sentence = _OPENING.get(number or 0)
    if sentence is None:
        return LinkError(f"{name} cannot be opened: {_reason(chain[-1])}; see `bilprov ports`")
    parts = urlsplit(name) if "://" in name else None
    return LinkError(
        sentence.format(
            name=name or "port ''",
            settings=settings,
            ports=", ".join(ports_here) or "none",
            address=parts.netloc if parts else name,
        )
    )


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
