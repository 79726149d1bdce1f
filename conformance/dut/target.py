"""The device under test, by its name or as an object, and the links to those without a line.

A name is `sim`, `emulator:KIND:FIRMWARE`, or else a port: a path or a pyserial URL.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from bilprov.analyzer.client import operations
from bilprov.analyzer.client.operations import Link, LinkListener
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.probes import NONE, Probe, look_time, open_probe
from bilprov.analyzer.client.rest import Rest
from bilprov.analyzer.files import from_json
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings, line_named, line_settings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.analyzer.transport.replug import Place
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures import topics
from bilprov.captures.schemas import MS, Asked, Look, Message, look_class
from bilprov.conformance.dut.simulator import CONFORMING, Fault, Simulator
from bilprov.spec.codec import spaced
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

# -- links without a line: to a device object in virtual time, and to a recording -----------------
# In virtual time all is exact and repeatable, as fast as the machine. Every reply of a user's
# device object is checked before the suite uses it. A recording replies to each operation with
# the same bytes, times and looks: the runner must request the operations that were recorded and
# send the same bytes; otherwise the recording has no reply, and `Strayed` says so.


# -- the interface of a device, and the environment of a run --------------------------------------
# That is what, besides grammar and options, is needed to repeat it.


class Observability(msgspec.Struct, frozen=True, rename={"available": "open", "costly": "sparse"}):
    """What a probe can see: nothing (`available` false), everything, or a few looks (`costly`).

    `why` says why something is not observable. A `foreign` probe is not the kit's own: single looks
    through it may be wrong. Recordings keep the fields under older names.
    """

    available: bool
    costly: bool = False
    why: str = "no probe; see --probe"
    foreign: bool = False


class Environment(msgspec.Struct, frozen=True, rename={"observability": "eyes"}):
    """Where and how a run takes place.

    `virtual` is true for a device object in virtual time, false for a port. `observability` says
    what can be observed, `power` whether the robot can be switched off and on. `device` and `link`
    describe the device and the link in the report only. `lossless` declares that nothing on the
    line is lost, changed or doubled: what is unexplained there is the device's, even if met once.
    `announced` is how long (s) the run was said to take, where it is to end if it takes three times
    as long; None for no limit.
    """

    virtual: bool
    observability: Observability
    power: bool
    device: str
    link: dict[str, Any]
    lossless: bool = False
    announced: float | None = None


class Device(typing.Protocol):
    """A device under test without I/O: bytes and times (ns) in, answers and looks out.

    Time begins at 0 with each run: each needs an object of its own. One without `look` is judged by
    its answers alone. One with an attribute `lossless` that is True declares that nothing between
    it and the suite is lost: a single unexplained mismatch is then a failure. One with a method
    `power_cycle(now)`, which switches it off and on, is tried after power-on from a motion too.
    """

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`; return the bytes the device has sent until then."""

    def deadline(self) -> int | None:
        """When (ns) the device next acts by itself, None if it only waits for bytes."""

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""


_METHODS = ("receive", "advance", "deadline")


class DeviceError(UserError, TypeError):
    """A device object breaks the interface `Device`. The message is one sentence."""


class CheckedDevice:
    """A device whose every wrong reply or exception becomes a DeviceError that names the method.

    Raises DeviceError where a method is missing. Times are in ns.
    """

    def __init__(self, device: Device, protocol: Protocol) -> None:
        for name in _METHODS:
            if not callable(getattr(device, name, None)):
                raise DeviceError(
                    f"the device object {type(device).__name__} has no method {name}; it takes "
                    "receive(bytes, now), advance(now), deadline() and, to be seen, look(now)"
                )
        self._device = device
        self._looks = look_class(protocol.state_type)

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._call("receive", self._device.receive, data, now)

    def advance(self, now: int) -> bytes:
        """The bytes the device sends until `now`."""
        data = self._call("advance", self._device.advance, now)
        if not isinstance(data, bytes):
            raise self._gave("advance", data, "bytes, b'' where it sends nothing")
        return data

    def deadline(self) -> int | None:
        """When the device next acts by itself, None if it only waits for bytes."""
        due = self._call("deadline", self._device.deadline)
        if due is not None and type(due) is not int:
            raise self._gave("deadline", due, "a time in ns as an int, or None")
        return due

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
        look = self._call("look", self._device.look, now)
        if not isinstance(look, Look) or not all(
            str(getattr(look, name)).isprintable() for name in look.words
        ):
            raise self._gave("look", look, "an instance of bilprov.Look")
        if isinstance(look, self._looks):
            return look
        told = {name: getattr(look, name, None) for name in self._looks.__struct_fields__[2:]}
        return self._looks(look.t, look.moving, **told)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now`; called only if the device has this method."""
        self._call("power_cycle", getattr(self._device, "power_cycle"), now)  # noqa: B009

    def _call(self, name: str, method: Callable[..., Any], *arguments: object) -> Any:
        try:
            return method(*arguments)
        except Exception as error:
            what = f"the device's {name} raised {type(error).__name__}: {error}"
            raise DeviceError(what) from error

    def _gave(self, name: str, value: object, wanted: str) -> DeviceError:
        return DeviceError(f"the device's {name} gave {value!r:.200}; it must give {wanted}")


class VirtualLink:
    """Does operations on a device object in virtual time: no waiting, the same result every time.

    `byte_time` is the time of one byte on the wire in ns.
    """

    def __init__(
        self, device: Device, byte_time: int, tap: operations.LinkListener | None = None
    ) -> None:
        self._device = device
        self._byte_time = byte_time
        self._tap = tap
        self._now = 0
        self._ready = 0
        self._heard: list[tuple[int, int]] = []

    @property
    def now(self) -> int:
        """The virtual time (ns) since the link was made."""
        return self._now

    def do(self, operation: operations.Operation) -> operations.Reply:
        """Do one operation at once. Raises DeviceError for a deadline that does not advance."""
        match operation:
            case operations.Send(data):
                if self._tap:
                    self._tap.sent(data, self._now)
                return self._send(data)
            case operations.Listen(count, patience):
                until = self._now + patience
                self._collect()  # also what is there already, if `patience` is 0
                while self._now < until and (count is None or len(self._heard) < count):
                    due = self._device.deadline()
                    self._pass(until if due is None else min(until, max(due, self._now)))
                    if due is not None and due <= self._now and self._device.deadline() == due:
                        raise DeviceError(
                            f"the device's deadline gave {due} again after advance({self._now}); "
                            "it must give a later time, or None"
                        )
                heard, self._heard = tuple(self._heard), []
                if heard:
                    # An answer takes a byte's time on the wire: the host sends only after it.
                    self._ready = heard[-1][0] + self._byte_time
                return operations.Received(heard[: operations.HELD_ANSWERS], self._now)
            case operations.PowerCycle():
                power = getattr(self._device, "power_cycle")  # noqa: B009  # not every device has
                power(self._now)
                self._heard.clear()
                return self._now
            case operations.Observe():
                look = self._device.look(self._now)
                if self._tap:
                    self._tap.looked(look)
                return operations.Observation(self._now, self._now, look)

    def _send(self, data: bytes) -> int:
        """Send bytes, each with its time on the wire; return when (ns) the last one arrived."""
        device, byte_time = self._device, self._byte_time
        if self._now < self._ready:
            self._pass(self._ready)
        for index in range(len(data)):
            arrives = self._now + byte_time
            due = device.deadline()
            if due is not None and due <= arrives:
                self._pass(arrives)
            self._now = arrives
            device.receive(data[index : index + 1], arrives)
            self._collect()
        return self._now

    def _pass(self, until: int) -> None:
        """Let time pass until `until` (ns); the device acts at each of its deadlines on the way."""
        while (due := self._device.deadline()) is not None and self._now < due < until:
            self._now = due
            self._collect()
        self._now = until
        self._collect()

    def _collect(self) -> None:
        data = self._device.advance(self._now)
        if data:
            self._heard += [(self._now, byte) for byte in data]
            if self._tap:
                self._tap.received(data, self._now)


TOPICS = frozenset({topics.HOST_RAW, topics.DEVICE_RAW, topics.LOOKS, topics.ASKS})
"""The topics read: bytes, looks, and when each operation was done. Verdicts are not read."""

CUT = "the recording ends here"

_SHOWN = 16  # bytes of a frame in a sentence
Read = TypeVar("Read", Asked, Look)


class Strayed(Exception):
    """The run requests another operation than was recorded; the message is one sentence."""


@dataclass(slots=True)
class _Step:
    """One recorded operation with the bytes and the look that belong to it."""

    asked: Asked
    sent: bytes
    received: list[tuple[int, int]]
    look: Look | None


class RecordedLink:
    """A link over the messages of a recording, in their order and of `TOPICS` alone.

    `cut` tells that the recording ended before the run did; `looks` is the class of its looks.
    """

    def __init__(self, messages: Iterator[Message], looks: type[Look]) -> None:
        self.cut = False
        self._looks = looks
        self._messages = messages
        self._heard: list[tuple[int, int]] = []
        self._number = 0
        self._next = self._read()

    @property
    def left(self) -> bool:
        """Whether the recording holds more operations than were requested."""
        return self._next is not None

    def interrupted(self) -> bool | str:
        """Whether the run was interrupted before its next operation; why, if the kit failed."""
        if self._next is None or self._next.asked.ask != operations.OPERATION_NAMES[type(None)]:
            return False
        asked = self._take(self._next).asked
        return str(asked.ended) if asked.error else True

    def do(self, operation: operations.Operation) -> operations.Reply:
        """Reply as it was recorded.

        Raises Ended where the operation could not be done, or the recording ends; Strayed where
        another operation was recorded.
        """
        step = self._next
        if step is None:
            self.cut = True
            raise operations.Ended(CUT, error=False, line_works=False)
        self._check(operation, step)
        asked = self._take(step).asked
        if asked.ended is not None and asked.lost is not None:
            self._heard.clear()
            raise operations.Reconnected(asked.ended, asked.lost, asked.t)
        if asked.ended is not None:
            works = bool(asked.line_works)
            raise operations.Ended(asked.ended, error=bool(asked.error), line_works=works)
        match operation:
            case operations.Listen():
                heard, self._heard = self._heard, []
                return operations.Received(tuple(heard[: operations.HELD_ANSWERS]), asked.t)
            case operations.Observe():
                assert step.look is not None
                assert asked.begun is not None
                return operations.Observation(asked.begun, asked.t, step.look)
            case operations.PowerCycle():
                self._heard = []
        return asked.t

    def _check(self, operation: operations.Operation, step: _Step) -> None:
        name, recorded = operations.OPERATION_NAMES[type(operation)], step.asked
        wanted = operation.data if isinstance(operation, operations.Send) else b""
        if recorded.ask != name:
            raise Strayed(f"{self._where} is {recorded.ask!r}, the kit now asks for {name!r}")
        if step.sent != wanted and (recorded.ended is None or step.sent):
            raise Strayed(f"{self._where} sends {_hex(step.sent)}, the kit now {_hex(wanted)}")
        seen = step.look is not None and recorded.begun is not None
        if isinstance(operation, operations.Observe) and recorded.ended is None and not seen:
            raise Strayed(f"{self._where} is an observation, but nothing was observed")

    @property
    def _where(self) -> str:
        return f"step {self._number} of the recording"

    def _take(self, step: _Step) -> _Step:
        """Finish a step: keep the bytes received during it, and read the next one."""
        self._heard += step.received
        self._next = self._read()
        return step

    def _read(self) -> _Step | None:
        """The next operation with the messages before it, None where the recording ends."""
        sent, received, look = bytearray(), list[tuple[int, int]](), None
        self._number += 1
        for message in self._messages:
            data = message.data
            if message.topic == topics.LOOKS:
                look = self._value(data, self._looks)
            elif message.topic == topics.ASKS:
                return _Step(self._value(data, Asked), bytes(sent), received, look)
            elif message.topic == topics.HOST_RAW:
                sent += data
            else:
                received += [(message.t, byte) for byte in data]
        return None

    def _value(self, data: bytes, kind: type[Read]) -> Read:
        try:
            return from_json(data, kind)
        except ValueError as error:
            raise Strayed(f"{self._where} cannot be read: {error}") from error


def _hex(data: bytes) -> str:
    more = f" and {len(data) - _SHOWN} bytes more" if len(data) > _SHOWN else ""
    return (spaced(data[:_SHOWN]) or "nothing") + more


SIM, SIMAVR, PORT = "sim", "simavr", "port"
"""The kinds of target."""
BOARD = "emulator:"
"""How the name of an emulated board begins."""


@dataclass(frozen=True, slots=True)
class TargetName:
    """The name of a target, its kind, and the ELF file where it is an emulated board."""

    text: str
    kind: str
    firmware: Path = Path()

    @property
    def own_probe(self) -> str | None:
        """The probe that the simulator or a board brings, None for a port."""
        return None if self.kind == PORT else self.kind


def target_named(text: str) -> TargetName:
    """Parse the name of a target.

    Raises ValueError, in one sentence, for an unknown emulator or a missing firmware file.
    """
    if text == SIM:
        return TargetName(text, SIM)
    if not text.startswith(BOARD):
        return TargetName(text, PORT)
    kind, _, file = text.removeprefix(BOARD).partition(":")
    if kind != SIMAVR or not file:
        raise ValueError(f"{text!r} names no board: write {BOARD}{SIMAVR}:FIRMWARE.elf")
    if not Path(file).exists():
        raise ValueError(f"there is no firmware {file}; build it with: make -C firmware")
    return TargetName(text, kind, Path(file))


@dataclass(frozen=True, slots=True)
class Target:
    """A device under test that is ready for a run.

    `connect` makes a link to it, whose clock begins then, and which tells a listener all that
    passes. `interrupted` tells whether the user wants the run to end or, in a sentence, what of the
    kit failed. `halt` is the last resort where the kit itself fails during a run, or is suspended:
    it stops a robot at a port as far as the line allows. `remark` gives what the user should know
    after a run. `moves` is true where a real robot will move, to which the user must agree first.
    """

    protocol: Protocol
    environment: Environment
    connect: Callable[[LinkListener | None], Link]
    interrupted: Callable[[], bool | str] = lambda: False
    halt: Callable[[], None] = lambda: None
    remark: Callable[[], str] = lambda: ""
    moves: bool = False

    @property
    def line(self) -> LineSettings:
        """The settings of its line."""
        return line_named(self.protocol, str(self.environment.link.get("line", "")))

    @property
    def byte_time(self) -> int:
        """How long (ns) a byte takes on its line: nothing on a pty or a socket."""
        return int(self.environment.link.get("byte_ns", self.line.byte_time))

    @property
    def latency(self) -> int:
        """For how long (ns) its adapter holds bytes back, as far as the system tells."""
        return int(self.environment.link.get("latency_ns", 0))

    @property
    def look_time(self) -> int:
        """How long (ns) a look of its probe took before the run, 0 where that was not measured."""
        return int(self.environment.link.get("look_ns", 0))


@contextmanager
def open_target(
    protocol: Protocol,
    name: TargetName,
    stopper: Stopper,
    *,
    settings: LineSettings | None = None,
    probe: str | None = None,
    power: str | None = None,
    fault: Fault | None = None,
    reconnect: float = 0.0,
) -> Iterator[Target]:
    """Open the target of that name; nothing is sent to it. `stopper` ends its runs.

    `settings` are those of a port's line (the grammar's own if None), `probe` names what sees its
    robot, `power` is a command that switches it off and on; `fault` is the simulator's. The
    simulator and a board have all these themselves. A port that is lost is waited for `reconnect`
    s.

    Raises LinkError, ProbeError and EmulatorError, in one sentence.
    """
    with ExitStack() as stack:
        if name.kind == SIM:
            robot = Simulator(protocol, fault)
            named = None if robot.fault is CONFORMING else robot.fault.name
            target = device_target(protocol, robot, fault=named)
        elif name.kind == SIMAVR:
            from bilprov.conformance.dut.boards.simavr import SimavrBoard

            board = stack.enter_context(closing(SimavrBoard(name.firmware)))
            target = device_target(protocol, board, name=name.text, probe=SIMAVR)
            crash = f"{name.firmware} crashed: the board has been silent since"
            target = replace(target, remark=lambda: crash if board.crashed else "")
        else:
            port = stack.enter_context(open_port(name.text, settings or line_settings(protocol)))
            probe = NONE if probe is None else probe
            eye = open_probe(probe, port, protocol)
            if eye:
                stack.callback(eye.close)
            if reconnect and not Place(port.name).lasts:
                raise LinkError(
                    f"{port.name} could not be found again once it is lost: --reconnect is for "
                    "paths of adapters and for links to them"
                )
            target = Target(
                protocol,
                _environment(protocol, port, eye, probe, power=power is not None),
                connect=lambda listener: PortLink(port, eye, stopper, listener, power, reconnect),
                halt=partial(Rest(protocol).halt, port),
                remark=lambda: eye.remark if eye is not None else "",
            )
        moves = name.kind == PORT
        yield replace(target, interrupted=lambda: stopper.stopped, moves=moves)


def device_target(
    protocol: Protocol,
    device: Device,
    *,
    name: str = SIM,
    probe: str = SIM,
    fault: str | None = None,
) -> Target:
    """A device object as a target in virtual time; `name`, `probe` and `fault` are for the report.

    Raises DeviceError for an object that lacks a method of `Device`.
    """
    line = line_settings(protocol)
    observability = Observability(
        hasattr(device, "look"), why="the device object has no method look"
    )
    power = hasattr(device, "power_cycle")
    about = {
        "kind": "virtual",
        "line": str(line),
        "probe": probe if observability.available else "none",
        "fault": fault,
    }
    lossless = getattr(device, "lossless", False) is True
    checked = device if isinstance(device, Simulator) else CheckedDevice(device, protocol)
    return Target(
        protocol,
        Environment(True, observability, power, name, about, lossless),
        connect=lambda listener: VirtualLink(checked, line.byte_time, listener),
    )


def _environment(
    protocol: Protocol, port: Port, probe: Probe | None, name: str, *, power: bool
) -> Environment:
    """The environment of a run at an open port in real time, whose probe has that name."""
    observability = Observability(available=False)
    if probe is not None:
        why = f"{name} is asked only about a few cases"
        observability = Observability(True, probe.costly, why, foreign=True)
    line = port.settings
    given = line.options(protocol)
    about = {
        "kind": "port",
        "line": str(line),
        "baud": line.baud,
        "byte_ns": port.byte_time,
        "latency_ns": (Machine().latency_timer(port.name) or 0) * MS,
        "look_ns": 0 if probe is None else look_time(probe),
        "probe": name,
        **({"options": given} if given else {}),
    }
    return Environment(False, observability, power, port.name, about)
