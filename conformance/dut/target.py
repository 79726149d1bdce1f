"""The device under test, by its name or as an object, and how to reach it.

A name is `sim`, `emulator:KIND:FIRMWARE`, or else a port: a path or a pyserial URL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from bilprov.analyzer.client.operations import Link, LinkListener
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.probes import NONE, Probe, look_time, open_probe
from bilprov.analyzer.client.rest import Rest
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings, line_named, line_settings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.analyzer.transport.replug import Place
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS
from bilprov.conformance.dut.links import (
    CheckedDevice,
    Device,
    Environment,
    Observability,
    VirtualLink,
)
from bilprov.conformance.dut.simulator import CONFORMING, Fault, Simulator
from bilprov.spec.protocol import Protocol

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
    if not Path(file).is_file():
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
