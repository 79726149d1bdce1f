"""Drives a robot on a port of this machine; homes it after opening and on every way out."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
import warnings
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from os import PathLike
from types import FrameType
from typing import Self

from bilprov.analyzer.client import driver
from bilprov.analyzer.client.operations import done
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.rest import Rest
from bilprov.analyzer.grammar_file import given_protocol
from bilprov.analyzer.transport import signals
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.spec.protocol import Protocol

_TURN = 0.01  # s between two looks at the port while a program waits
_PATIENCE = 1.0  # s for another thread's exchange to end before the robot is stopped


@dataclass(eq=False)
class _OpenRobot:
    """Stops the robot of a driver without the driver: at a signal, and when that was dropped.

    `in_block` tells whether the main thread is in its `with`, and so gets an exception from a
    signal; `halted` whether a signal stopped it, and it was not used since; `why`, where no
    exception has said so; `over` whether nobody may use it again once it was stopped.
    """

    rest: Rest
    noun: str
    port: Port
    turns: driver.Turns
    in_block: bool = False
    halted: bool = False
    why: str = ""
    over: bool = False
    process: int = field(default_factory=os.getpid)

    def halt(self, why: str) -> None:
        """Stop the robot, where the grammar tells how.

        Whoever uses it next is told why, unless an exception does now.
        """
        if not self.rest.frames() or self.process != os.getpid():  # it is the parent's
            return
        with self.turns.taken(_PATIENCE) as alone, suppress(LinkError):
            self.halted, self.why = True, "" if self.in_block else self.stopped_words(why)
            if self.in_block or not alone:  # the end of the block homes it
                self.rest.halt(self.port)
            else:
                done(self.rest.once(), PortLink(self.port))

    def stopped_words(self, why: str) -> str:
        """Why it was stopped, in words."""
        return f"{why}, and the {self.noun} was stopped before that"

    def drop(self) -> None:
        """Home the robot and close its port, and warn that nobody did."""
        _open.discard(self)
        if self.process != os.getpid():
            return
        self.in_block = False  # or it was left without its end, as a generator is
        self.halt("the program ended")
        self.port.close()
        what = f"the {self.noun} at {self.port.name} was never closed"
        what += ", and was stopped only now" if self.halted else ""
        warnings.warn(f"{what}: use it in a with block", ResourceWarning, stacklevel=2)


_open: set[_OpenRobot] = set()
_SUSPENDED = "the program was suspended"


def _halt_all(number: int) -> None:
    """Stop every open robot, for this signal."""
    try:
        why = f"{signal.Signals(number).name} came"
    except ValueError:  # a real-time signal has no name
        why = f"signal {number} came"
    for robot in list(_open):
        robot.halt(_SUSPENDED if number in signals.SUSPENDING else why)


def _heard(number: int, frame: FrameType | None) -> None:
    """Stop every open robot, then do what this signal usually does.

    In a `with` block that is an exception, so that the block's cleanup runs, as after Ctrl-C. The
    robot is stopped before it: a second signal may end the cleanup before it has begun.
    """
    _halt_all(number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    in_block = any(robot.in_block for robot in _open)
    if in_block and number not in signals.SUSPENDING:
        sys.exit(128 + number)
    signals.as_usual(number)
    for robot in _open:
        if robot.in_block and robot.halted:
            raise driver.RobotError(robot.stopped_words(_SUSPENDED))


def _handle_signals() -> None:
    """Have every open robot stopped by each signal before it ends or suspends the program.

    Raises RuntimeError in a thread that cannot arrange that.
    """
    if signals.in_main_thread():
        signals.handled_from_now_on(_heard)
        return
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        raise RuntimeError(
            "a robot in this thread could not be stopped by a signal: import Robot in the main "
            "thread before this one starts"
        )


@cache
def _watch_main_thread() -> None:
    """Once Ctrl-C has ended the main thread, stop the robots that other threads drive on."""

    def watch() -> None:
        threading.main_thread().join()
        if isinstance(getattr(sys, "last_value", None), KeyboardInterrupt):
            for robot in list(_open):
                robot.over = True
            _halt_all(signal.SIGINT)

    threading.Thread(target=watch, name="bilprov robots", daemon=True).start()


if signals.in_main_thread():  # a robot that is opened in another thread later needs it
    _handle_signals()


class OnPort(driver.InstructionMethods):
    """One robot on a port; a context manager that homes it on every way out.

    `url` is a path or any pyserial URL. `grammar` is the name of a shipped grammar, a file or a
    Protocol, the kit's own unless given. Where its frames have an address, `address` is the device
    that is meant unless a method is called with another one. With `only_reading` what may change
    something raises ValueError and is not sent. `timeout` is how long (ms) an answer may take;
    `baud` (bits/s), `parity` (N E O M S) and `stopbits` (1 1.5 2) are the grammar's unless given.
    With `echo` what is sent comes back on the line, as on a bus whose adapter hears itself, and is
    taken away.

    Opening sends only stops, until the robot answers, so it starts no motion. It asks for no
    confirmation, since starting the program is the user's consent. Raises LinkError for a port
    that cannot be opened, NoAnswer if the robot does not answer, GrammarError and ValueError for
    wrong use.

    Within `with`, the robot is also homed after Ctrl-C, and after any other signal that ends the
    program unless the program handles it itself; a second signal waits until homing has ended.
    Ctrl-Z, or reading from the terminal in the background, stops it before the program is
    suspended; once that is continued, RobotError is raised.
    An exception raised in the block is kept; if the robot could not be homed, a note on the
    exception says so. A robot that is dropped without `close`, or is open when the program ends, is
    homed too, with a ResourceWarning.

    Several threads may use it, and it may be opened in any of them: a signal stops it there too,
    and if the program goes on, whoever uses it next gets a RobotError. Signals can only be handled
    from the main thread, so that has to import this class before another thread opens a robot;
    RuntimeError otherwise.
    """

    def __init__(
        self,
        url: str | PathLike[str],
        *,
        grammar: str | PathLike[str] | Protocol | None = None,
        address: int | None = None,
        only_reading: bool = False,
        timeout: float | None = None,
        baud: int | None = None,
        parity: str | None = None,
        stopbits: float | None = None,
        echo: bool = False,
    ) -> None:
        grammar = given_protocol(grammar)
        if address is not None:
            driver.require_address(grammar, address)
        number = timeout is None or isinstance(timeout, int | float)
        if not number or (timeout is not None and not 0 < timeout < math.inf):
            raise ValueError(f"timeout is {timeout!r}, allowed are milliseconds above 0")
        _handle_signals()
        settings = line_settings(grammar, baud, parity, stopbits, echo=echo)
        self._port = open_port(os.fspath(url), settings)
        self._port_name = self._port.name
        self._address, self._only_reading = address, only_reading
        self._least_pause = Machine().least_pause(self._port_name)
        self._open = True
        self._signals = ExitStack()
        try:
            super().__init__(grammar, PortLink(self._port), timeout)
            self._held = _OpenRobot(self._rest, grammar.device, self._port, self._turns)
            self.home()
        except BaseException:
            self._port.close()
            raise
        self._dropped = weakref.finalize(self, self._held.drop)
        util = sys.modules.get("multiprocessing.util")
        if util is not None:  # its child may end without what Python does at the end of a program
            util.Finalize(self, self._dropped, exitpriority=0)
        _open.add(self._held)

    def close(self) -> None:
        """Home the robot and close the port; further calls do nothing.

        Raises NoAnswer if the robot does not answer and LinkError if the line is lost; in both
        cases the robot may still be moving.
        """
        if not self._open:
            return
        try:
            with Stopper() as postponed:
                self._open = False  # first: other threads send nothing more
                with self._turns.taken(), ExitStack() as last:
                    last.callback(self._port.close)
                    last.callback(self._dropped.detach)
                    if self._rest.frames() and not self._do(self._rest.once()):
                        raise self._nobody()
            postponed.pass_on()
        finally:
            _open.discard(self._held)

    def wait(self, milliseconds: float) -> None:
        """Wait for the given time; other threads may use the robot meanwhile.

        Raises RobotError if the robot sends an unsolicited byte, and LinkError.
        """
        until = time.monotonic() + milliseconds / 1000
        super().wait(0)
        while (left := until - time.monotonic()) > 0:
            time.sleep(min(left, _TURN))
            super().wait(0)

    def __enter__(self) -> Self:
        self._held.in_block = signals.in_main_thread()
        self._signals.enter_context(signals.handled(signals.unhandled([signal.SIGINT]), _heard))
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._signals:
            try:
                self.close()
            except (driver.RobotError, LinkError) as left:
                if error is None:
                    raise
                error.add_note(
                    f"the {self.protocol.device} was not brought to a stop at the end: {left}"
                )

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._port.name} {self.protocol.name}>"

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if not signals.in_main_thread():
            _watch_main_thread()
        with super()._alone():
            if not self._open:
                raise LinkError(f"{self._port.name} is closed")
            if self._held.halted:
                self._in_step, self._held.halted = False, self._held.over
                if self._held.why:
                    raise driver.RobotError(self._held.why)
            yield


class PortDriver(OnPort, driver.Driver):
    """One robot on a port; `OnPort` describes how it is opened, and how it is left."""


class Device(OnPort, driver.DeviceDriver):
    """A device on a port, driven from Python; each instruction of the grammar is a method.

        with Device("/dev/ttyUSB0", grammar="modbus-rtu", address=17) as meter:
            first, second = meter.read_holding_registers(start=0, quantity=2)

    `OnPort` describes the arguments and how it is left, `DeviceDriver` the methods and the
    exceptions. Nothing is sent at first and at the end, unless the grammar tells when the device is
    at rest.
    """
