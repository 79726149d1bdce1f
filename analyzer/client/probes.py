"""The probes of `--probe`, which tell whether the robot moves: each is asked and returns a Look.

A probe has a file descriptor to wait for with select, so that the port is read meanwhile.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any

import msgspec

from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.server import parse_address
from bilprov.captures.schemas import Look, look_class
from bilprov.captures.text import escape_controls, printable, quantity
from bilprov.captures.topics import CarLook
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_LONGEST = 1 << 16  # bytes of a line of the tcp probe
_LONGEST_NAME = 200  # characters of a motion
_LOOKS = 5  # to measure how long one takes

ASK, NONE = "ask", "none"
"""The probe that needs a person at a terminal, and no probe, as a port has it by default."""
MODEM_LINES = ("cts", "dsr", "dcd", "ri")
PROBES = ("tcp:HOST:PORT", "exec:COMMAND", "modem:LINE", ASK, NONE)
"""The forms of the names of probes."""


class ProbeError(UserError):
    """The probe cannot be asked or does not answer as agreed, in one sentence."""


def _wait(patience: int, waits: int) -> bool:
    return bool(select.select([waits], [], [], max(0, patience) / 1e9)[0])


class Probe(ABC):
    """An observer of the robot: sees whether it moves, and possibly more of its state.

    `costly` means that only the thorough cases are observed; `patience` is how long a look may take
    (s).
    """

    costly = False
    patience = 1.0
    looks: type[Look] = CarLook  # the class of its looks

    remark = ""
    """What the user should know of it after a run, in one sentence; "" for nothing."""

    def look(
        self,
        now: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[int, int], bool] = _wait,
        *,
        asked: bool = False,
    ) -> Look:
        """Ask, unless that is done, and return the look, as of `now` (ns).

        `wait` waits at most some ns for a descriptor, and returns whether it is readable. Raises
        ProbeError.
        """
        until = now() + int(self.patience * 1e9)
        if not asked:
            self.ask()
        while True:
            waits = self.fileno()
            if waits is None or wait(until - now(), waits):
                look = self.take(now())
                if look is not None:
                    return look
            elif now() >= until:
                raise ProbeError(f"the probe did not answer in {self.patience:g} s")

    def ask(self) -> None:  # noqa: B027  # some can be read at any time
        """Begin a look. Raises ProbeError."""

    def fileno(self) -> int | None:
        """The file descriptor to wait for before `take`; None if the look is there at once."""
        return None

    @abstractmethod
    def take(self, now: int) -> Look | None:
        """The look, as of `now` (ns); None while it is incomplete. Raises ProbeError."""

    def close(self) -> None:  # noqa: B027  # most have nothing to release
        """Release the probe."""


# Beyond the range of every facet; larger numbers could not be recorded either.
_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


@cache
def _facets_class(looks: type[Look]) -> Any:
    """The class of what stands in a line of the tcp probe; anything else in it is ignored."""
    kinds: dict[str, Any] = {"moving": bool | None, **dict.fromkeys(looks.words, str | None)}
    fields = [(name, kinds.get(name, _Number | None), None) for name in looks.__struct_fields__[1:]]
    return msgspec.defstruct("Facets", [*fields, ("number", int | None, None)])


def parse_look(line: bytes, now: int, looks: type[Look] = CarLook) -> tuple[Look, int | None]:
    """A line of JSON as a look of a class, and the line's number if it has one.

    Raises ProbeError unless it has known facets.
    """
    try:
        facets = msgspec.json.decode(line.decode(), type=_facets_class(looks))
    except (ValueError, RecursionError) as error:
        raise ProbeError(
            f"the probe answered {printable(line.decode(errors='replace'))!r}, which is not a line "
            f'of JSON such as {{"moving": true}} ({error})'
        ) from error
    told = {}
    for name in looks.__struct_fields__[2:]:
        value = getattr(facets, name)
        if isinstance(value, str):
            value = escape_controls(value[:_LONGEST_NAME])[:_LONGEST_NAME]
        elif value is not None:  # a wheel that turns slowly still turns
            value = round(value) or (value > 0) - (value < 0)
        told[name] = value
    return looks(t=now, moving=facets.moving, **told), facets.number


class TcpProbe(Probe):
    """A program on a TCP port: it gets `state` and a newline and returns one line of JSON.

    There is one connection for the whole run. A program whose lines hold a `number` gets one behind
    `state` and repeats it (0 where it got none): a line with another number is dropped. From one
    without numbers the next line may be the reply to an earlier question, once it has sent a line
    more than it was asked for: from then on its looks are unknown.
    """

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
        self._lines: list[bytes] = []  # complete, and not yet looked at
        self._number = 0
        self._numbered = False
        self._surplus = 0

    @property
    def remark(self) -> str:  # type: ignore[override]  # of which there is news at any time
        """How many lines came that were not asked for, and what that means for the looks."""
        if not self._surplus:
            return ""
        said = f"the probe sent {quantity(self._surplus, 'line')} more than it was asked for"
        if self._numbered:
            return f"{said}; they were dropped by their numbers"
        return (
            f"{said}, so what it sent from then on was ignored: let it send one line for each "
            "question, or repeat the number of the question"
        )

    def ask(self) -> None:
        """Ask for the state; what has come unasked is dropped and counted."""
        self._receive()
        self._surplus += len(self._lines)
        self._lines.clear()
        if self._numbered:
            self._number += 1
        request = f"state {self._number}\n" if self._numbered else "state\n"
        try:
            self._socket.sendall(request.encode())
        except OSError as error:
            raise self._hung_up(f" ({error.strerror})") from error

    def fileno(self) -> int:
        """The connection."""
        return self._socket.fileno()

    def take(self, now: int) -> Look | None:
        """The look, once the line of the reply is complete. Raises ProbeError."""
        self._receive()
        while self._lines:
            line = self._lines.pop(0)
            if self._surplus and not self._numbered:
                return self.looks(t=now, moving=None)
            look, number = parse_look(line, now, self.looks)
            self._numbered = self._numbered or number is not None
            if not self._numbered or number == self._number:
                return look
            self._surplus += 1
        return None

    def _receive(self) -> None:
        """Read what is there, without waiting."""
        try:
            data = self._socket.recv(_LONGEST)
        except BlockingIOError:
            return
        except OSError as error:
            raise self._hung_up(f" ({error.strerror})") from error
        if not data:
            raise self._hung_up()
        *lines, self._held = (self._held + data).split(b"\n")
        self._lines += lines
        if len(self._held) > _LONGEST:
            raise ProbeError(f"the probe at {self._name} sends no end of line")

    def _hung_up(self, why: str = "") -> ProbeError:
        return ProbeError(
            f"the probe at {self._name} hung up{why}: check that its program keeps running and "
            "keeps the connection for the whole run, then try again"
        )

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


class ExecProbe(Probe):
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
                self._command,
                shell=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                process_group=0,  # so that what the shell starts ends with it
            )
        except OSError as error:
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
            return self.looks(t=now, moving=False)
        return self.looks(t=now, moving=True if code == 1 and b"moving" in self._output else None)

    def close(self) -> None:
        """End the command."""
        process, self._process = self._process, None
        if process is not None:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            if process.stdout is not None:
                process.stdout.close()


class ModemProbe(Probe):
    """A modem line of the port itself, wired so that it is asserted while the robot moves."""

    def __init__(self, port: Port, line: str) -> None:
        self._port = port
        self._line = line
        if port.modem_line(line) is None:
            raise ProbeError(f"{port.name} has no modem lines, so --probe modem:{line} cannot see")

    def take(self, now: int) -> Look:
        """The look, from the present state of the modem line."""
        return self.looks(t=now, moving=self._port.modem_line(self._line))


class AskProbe(Probe):
    """A person who watches the robot and answers yes or no."""

    costly = True
    patience = 600.0

    def __init__(self) -> None:
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            raise ProbeError("--probe ask needs a terminal where somebody can answer")

    def ask(self) -> None:
        """Print the question on the terminal."""
        sys.stderr.write("\rDoes the robot move now? [y/n, Enter = unknown] ")
        sys.stderr.flush()

    def fileno(self) -> int:
        """The terminal."""
        return sys.stdin.fileno()

    def take(self, now: int) -> Look:
        """The look, from the answer typed; whether it moves is unknown unless that is yes or no."""
        answer = sys.stdin.buffer.readline().strip().lower()
        moving = {b"y": True, b"yes": True, b"n": False, b"no": False}.get(answer)
        return self.looks(t=now, moving=moving)


def open_probe(name: str, port: Port, protocol: Protocol) -> Probe | None:
    """The probe of that name, for the robot of this protocol at this port; None for `none`.

    Raises ProbeError, in one sentence, for a name of none of the PROBES, and for a probe that
    cannot be reached.
    """
    kind, _, rest = name.partition(":")
    probe: Probe | None = None
    if kind == "tcp" and rest:
        probe = TcpProbe(rest)
    elif kind == "exec" and rest:
        probe = ExecProbe(rest)
    elif kind == "modem" and rest in MODEM_LINES:
        probe = ModemProbe(port, rest)
    elif name == ASK:
        probe = AskProbe()
    elif name != NONE:
        *forms, last = (form.replace("LINE", "|".join(MODEM_LINES)) for form in PROBES)
        allowed = f"{', '.join(forms)} or {last} (and sim, for the target sim)"
        raise ProbeError(f"--probe is {name!r}; it can be {allowed}")
    if probe is not None:
        probe.looks = look_class(protocol.state_type)
    return probe


def look_time(probe: Probe) -> int:
    """How long (ns) a look takes: the shortest of a few, one of a command, 0 for a person.

    The first of several is not counted: a probe that looks at fixed times is met between two. It is
    0 too where a look fails, which the run then meets. Raises ProbeError where none comes in time:
    a reply that came later would be taken for that to another question.
    """
    times = [0] if isinstance(probe, AskProbe) else []
    while len(times) < (1 if probe.costly else _LOOKS):
        begun = time.monotonic_ns()
        try:
            probe.look()
        except ProbeError:
            if time.monotonic_ns() - begun >= probe.patience * 1e9:
                raise
            return 0
        times.append(time.monotonic_ns() - begun)
    return min(times[1:] or times)
