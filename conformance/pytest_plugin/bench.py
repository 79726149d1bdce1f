"""Runs the suite step by step for pytest, or gives clients to tests; never both at once.

A run goes on while a result is waited for, and rests between two cases, when the robot is homed.
However it ends, the robot is homed. A client uses a link, so that a test works alike on a port in
real time and on a simulator in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, TypeVar

from bilprov.analyzer.client.driver import Answer, RobotError
from bilprov.analyzer.client.operations import Ended, Link, Procedure, drive, listen, observe
from bilprov.analyzer.client.probes import ASK
from bilprov.analyzer.client.robot import Instructions
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.api import (
    Options,
    opening_and_reading_cases,
    select_cases,
    suite_steps,
)
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.dut.simulator import Fault
from bilprov.conformance.dut.target import SIM, Target, open_target, target_named
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol

_SETTLE = 2 * MS
T = TypeVar("T")


class Client(Instructions):
    """One robot on a link, driven as a `Robot` is. `sees` says whether there is a probe to look.

    Nothing is sent until `home` or an instruction is called. Every method raises RobotError where
    the robot does not answer, sends an unsolicited answer, or cannot be reached any more. Once it
    is `over` no instruction is sent any more, whoever kept the client.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        super().__init__(protocol, link)
        self.sees = sees
        self.over = False

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes unchanged, as a `Robot` does."""
        with self._alone():
            if self.over:
                raise RobotError("the test that used the robot is over")
            return super().send_bytes(data, answers)

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to observe the robot; see --robot-probe")
        return self._do(observe()).look

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        Speed and LED stay as they were. The probe, if there is one, must see it stand still.
        """
        super().home()
        # Link and probe are two lines: a look may be a little older than the answer.
        until = self._do(listen(None, 0)).now + round(self.protocol.timing.stop_longest * MS)
        while self.sees and self.look().moving:
            if self._do(listen(None, _SETTLE)).now >= until:
                raise RobotError("the robot still moves although it was sent a stop")

    def _do(self, procedure: Procedure[T]) -> T:
        try:
            return drive(procedure, self._link)
        except Ended as ended:
            raise RobotError(str(ended)) from ended


class Bench(RunListener):
    """One run of the suite, and any number of clients, on a port, `sim` or an emulated board.

    Nothing is opened before `open`. `close` stops a run that is still going, and homes. `unplanned`
    gets the results of cases that are not in `order`. `link` is the run's, once it has begun.

    Raises ValueError, in one sentence, for a target or a probe that cannot be used.
    """

    link: dict[str, Any]

    def __init__(
        self,
        protocol: Protocol,
        target: str,
        *,
        options: Options,
        settings: LineSettings,
        probe: str | None,
        fault: Fault | None,
    ) -> None:
        self.protocol, self.target, self.options = protocol, target, options
        self._name = name = target_named(target)
        if name.own_probe and probe not in (None, SIM):
            raise ValueError(f"--robot-port {target} brings its own probe: leave --robot-probe out")
        if probe == ASK:
            raise ValueError(
                f"--robot-probe {probe} cannot be used under pytest; run bilprov conform"
            )
        self.report: Report | None = None
        self.unplanned: list[CaseResult] = []
        self._stopper = Stopper()
        self._open_target = partial(
            open_target, protocol, name, self._stopper, settings=settings, probe=probe, fault=fault
        )
        self._stack = ExitStack()
        self._port: Target | None = None
        self._run: Generator[None] | None = None
        self._going = False  # a step of the run is under way
        self._results: dict[str, CaseResult] = {}

    @cached_property
    def cases(self) -> tuple[AnyCase, ...]:
        """The cases of the options, which take seconds to make. Raises as `select_cases` does."""
        return select_cases(self.protocol, self.options)

    @cached_property
    def order(self) -> Mapping[str, int]:
        """The ids of the cases with their places in a run. Raises as `select_cases` does."""
        cases = (*opening_and_reading_cases(self.protocol), *self.cases)
        return {case.id: at for at, case in enumerate(cases)}

    def open(self, confirm: Callable[[Target], None]) -> None:
        """Open port and probe, and call `confirm`, which raises if the robot may not move.

        It is not called for the simulator or an emulated board, which move nothing. Raises
        LinkError, ProbeError and EmulatorError, in one sentence.
        """
        if self._name.own_probe:
            with self._opened():  # raises if the firmware cannot be run
                return
        self._port = self._stack.enter_context(self._open_target())
        confirm(self._port)
        self._stopper.before_suspending(self._port.halt)

    def _opened(self) -> AbstractContextManager[Target]:
        """The robot at the port; a target in virtual time is opened anew, just after power-on."""
        return self._open_target() if self._port is None else nullcontext(self._port)

    # -- the run ----------------------------------------------------------------------------------

    def start(self, ids: Collection[str]) -> None:
        """Begin the run of these cases, in the suite's order. Only the first call has an effect."""
        if self._run is None:
            options = self.options
            if self.order.keys() - set(ids):
                options = replace(options, only=tuple(ids))
            self._run = self._steps(options)

    def result(self, ident: str) -> CaseResult | None:
        """A case's result once it is final; None when the run has ended without one.

        Raises what broke the run, if the kit did, and KeyboardInterrupt where a signal ended it.
        """
        while ident not in self._results and self._step():
            pass
        if self._stopper.stopped:
            raise KeyboardInterrupt
        return self._results.get(ident)

    @property
    def why_not(self) -> str:
        """Why a case has no result although the run has ended; "" if the run did not need it."""
        if self.report is None:
            return "the run broke off"
        return self.report.unusable or self.report.ended or ""

    def finish(self) -> None:
        """Let the run go on to its end."""
        while self._step():
            pass

    def interrupt(self) -> bool:
        """Let a run that has begun end soon; whether a step of it is under way, which goes on."""
        if self._run is not None:
            self._stopper.stop()
        return self._going

    def halt(self) -> None:
        """Stop the robot at the port at once: a test may go on after Ctrl-C."""
        if self._port is not None:
            self._port.halt()

    def stop(self) -> None:
        """End a run that is still going; homes the robot, and ignores a second Ctrl-C meanwhile."""
        with Stopper():
            self.interrupt()
            self.finish()

    def _step(self) -> bool:
        """Do one operation of the run; whether there was one."""
        self._going = True
        try:
            return self._run is not None and next(self._run, self) is None
        finally:
            self._going = False

    def _steps(self, options: Options) -> Generator[None]:
        with self._opened() as target:
            self.link = target.environment.link
            self.report = yield from suite_steps(target, options, [self])

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._results[result.id] = result
        if result.id not in self.order:
            self.unplanned.append(result)

    # -- clients ----------------------------------------------------------------------------------

    @contextmanager
    def client(self) -> Iterator[Client]:
        """A client of the robot, which is homed before and after. Waits for the end of a run.

        Raises RobotError where the robot cannot be homed.
        """
        self.finish()
        with self._opened() as target:
            eyes = target.environment.observability
            sees = eyes.available and not eyes.costly
            client = Client(self.protocol, target.connect(None), sees=sees)
            client.home()
            try:
                yield client
            finally:
                with Stopper() as postponed:
                    client.over = True
                    client.home()
                postponed.pass_on()

    def close(self) -> None:
        """Stop a run that is still going and close the port; may be called more than once."""
        self.stop()
        self._stack.close()
        self._stopper.close()
