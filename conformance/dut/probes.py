"""The probes of `--probe`, which tell whether the robot moves: each is asked and returns a Look.

A probe has a file descriptor to wait for with select, so that the port is read meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from typing import Annotated, Protocol

import msgspec

from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.streams import parse_address
from bilprov.captures.schemas import Look
from bilprov.captures.text import printable
from bilprov.spec.errors import UserError

MODEM_LINES = ("cts", "dsr", "dcd", "ri")


class ProbeError(UserError):
    """The probe cannot be asked or does not answer as agreed, in one sentence."""


class Probe(Protocol):
    """An observer of the robot: sees whether it moves, and possibly more of its state."""

    @property
    def costly(self) -> bool:
        """Whether a look is costly, so that only the thorough cases are observed."""

    @property
    def patience(self) -> float:
        """How long (s) a look may take."""

    def ask(self) -> None:
        """Begin a look. Raises ProbeError."""

    def fileno(self) -> int | None:
        """The file descriptor to wait for before `take`; None if the look is there at once."""

    def take(self, now: int) -> Look | None:
        """The look, as of `now` (ns); None while it is incomplete. Raises ProbeError."""

    def close(self) -> None:
        """Release the probe."""


def open_probe(name: str, port: Port) -> Probe | None:
    """The probe of that name: `none`, `tcp:HOST:PORT`, `exec:COMMAND`, `modem:LINE` or `ask`.

    Raises ProbeError, in one sentence, for a name that is none of these or cannot be reached.
    """
    kind, _, rest = name.partition(":")
    if name == "none":
        return None
    if name == "ask":
        return AskProbe()
    if kind == "tcp" and rest:
        return TcpProbe(rest)
    if kind == "exec" and rest:
        return ExecProbe(rest)
    if kind == "modem" and rest in MODEM_LINES:
        return ModemProbe(port, rest)
    raise ProbeError(
        f"--probe is {name!r}; it can be tcp:HOST:PORT, exec:COMMAND, modem:cts|dsr|dcd|ri, ask or "
        "none (and sim, for the target sim)"
    )


# Beyond the range of every facet; larger numbers could not be recorded either.
_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class _Facets(msgspec.Struct):
    """The facets in a line of the tcp probe; anything else in it is ignored."""

    moving: bool | None = None
    motion: str | None = None
    speed: _Number | None = None
    steering: _Number | None = None
    led: _Number | None = None
    left: _Number | None = None
    right: _Number | None = None


def _whole(value: float | None) -> int | None:
    """A number as an integer that keeps its sign: a wheel that turns slowly still turns."""
    if value is None:
        return None
    away = -1 if value < 0 else 1
    return round(value) or (away if value else 0)


def parse_look(line: bytes, now: int) -> Look:
    """A line of JSON as a Look. Raises ProbeError unless it is an object of known facets."""
    try:
        facets = msgspec.json.decode(line.decode(), type=_Facets)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProbeError(
            f"the probe answered {printable(line.decode(errors='replace'))!r}, "
            "which is not a line of "
            f'JSON such as {{"moving": true}} ({error})'
        ) from error
    numbers = {
        name: _whole(getattr(facets, name))
        for name in ("speed", "steering", "led", "left", "right")
    }
    motion = None if facets.motion is None else printable(facets.motion)
    return Look(t=now, moving=facets.moving, motion=motion, **numbers)


class TcpProbe:
    """A program on a TCP port: it gets `state` and a newline and returns one line of JSON.

    There is one connection for the whole run.
    """

    costly = False
    patience = 1.0

    def __init__(self, address: str) -> None:
        self._name = f"tcp:{address}"
        try:
            host, port = parse_address(address)
            self._socket = socket.create_connection((host, port), timeout=self.patience)
        except ValueError as error:
            raise ProbeError(f"--probe {self._name}: {error}") from error
        except OSError as error:
            raise ProbeError(
                f"the probe at {self._name} cannot be reached ({error.strerror or error}); is it "
                "running there?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._held = b""

    def ask(self) -> None:
        """Ask for the state."""
        try:
            self._socket.sendall(b"state\n")
        except OSError as error:
            raise self._hung_up(f" ({error.strerror})") from error

    def fileno(self) -> int:
        """The connection."""
        return self._socket.fileno()

    def take(self, now: int) -> Look | None:
        """The look, once the line of the reply is complete. Raises ProbeError."""
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._hung_up(f" ({error.strerror})") from error
        if not data:
            raise self._hung_up()
        line, newline, self._held = (self._held + data).partition(b"\n")
        if not newline:
            self._held = line
            if len(line) > 1 << 16:
                raise ProbeError(f"the probe at {self._name} sends no end of line")
            return None
        return parse_look(line, now)

    def _hung_up(self, why: str = "") -> ProbeError:
        return ProbeError(
            f"the probe at {self._name} hung up{why}: see that its program runs on and keeps the "
            "connection for the whole run, then try again"
        )

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


class ExecProbe:
    """A command run for each look: exit 0 is stopped, exit 1 with `moving` on stdout is moving.

    Any other result is unknown.
    """

    costly = True
    patience = 10.0

    def __init__(self, command: str) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._output = b""

    def ask(self) -> None:
        """Start the command."""
        self._output = b""
        try:
            self._process = subprocess.Popen(
                self._command, shell=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
            )
        except (OSError, ValueError) as error:  # ValueError: a nul byte
            raise ProbeError(f"--probe exec: {error}") from error

    def fileno(self) -> int:
        """The pipe of the command's output."""
        assert self._process is not None
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def take(self, now: int) -> Look | None:
        """The look, once the command has ended. Raises ProbeError."""
        assert self._process is not None
        data = os.read(self.fileno(), 4096)
        self._output = (self._output + data)[:4096]
        if data:
            return None
        try:
            code = self._process.wait(timeout=self.patience)
        except subprocess.TimeoutExpired as error:
            self.close()
            raise ProbeError(f"the probe's command {self._command!r} does not end") from error
        self.close()
        if code in (126, 127):
            raise ProbeError(f"the probe's command {self._command!r} cannot be run (exit {code})")
        if code == 0:
            return Look(t=now, moving=False)
        return Look(t=now, moving=True if code == 1 and b"moving" in self._output else None)

    def close(self) -> None:
        """End the command."""
        process, self._process = self._process, None
        if process is not None:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()


class ModemProbe:
    """A modem line of the port itself, wired so that it is asserted while the robot moves."""

    costly = False
    patience = 1.0

    def __init__(self, port: Port, line: str) -> None:
        self._port = port
        self._line = line
        if port.modem_line(line) is None:
            raise ProbeError(f"{port.name} has no modem lines, so --probe modem:{line} cannot see")

    def ask(self) -> None:
        """Do nothing: the line can be read at any time."""

    def fileno(self) -> None:
        """None: the look is there at once."""

    def take(self, now: int) -> Look:
        """The look, from the present state of the modem line."""
        return Look(t=now, moving=self._port.modem_line(self._line))

    def close(self) -> None:
        """Do nothing: the port is closed by its owner."""


class AskProbe:
    """A person who watches the robot and answers yes or no."""

    costly = True
    patience = 600.0

    def __init__(self) -> None:
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            raise ProbeError("--probe ask needs a terminal where somebody can answer")

    def ask(self) -> None:
        """Print the question on the terminal."""
        sys.stderr.write("\rDoes the robot move now? [y/n, Enter = cannot tell] ")
        sys.stderr.flush()

    def fileno(self) -> int:
        """The terminal."""
        return sys.stdin.fileno()

    def take(self, now: int) -> Look:
        """The look, from the answer typed; whether it moves is unknown unless that is yes or no."""
        answer = sys.stdin.buffer.readline().strip().lower()
        moving = {b"y": True, b"yes": True, b"n": False, b"no": False}.get(answer)
        return Look(t=now, moving=moving)

    def close(self) -> None:
        """Leave the terminal as it is."""
        with contextlib.suppress(OSError):
            sys.stderr.flush()
