"""A robot under a test runner: one run of cases beside the caller, or clients, never both at once.

The run goes in a thread of its own, so that its times are its own, and hands out each result as it
becomes final. Every way out of it homes the robot.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

from analyzer.transport.line_settings import LineSettings
from analyzer.transport.port import Port
from analyzer.transport.ports import open_port
from analyzer.transport.signals import Stopper, undisturbed
from conformance.api import (
    Options,
    always,
    conform,
    conform_port,
    estimated_seconds,
    select_cases,
)
from conformance.dut.boards.target import board_named
from conformance.dut.link import Device, Link, VirtualLink
from conformance.dut.port_link import PortLink
from conformance.dut.power import Power
from conformance.dut.probes import Probe, ProbeError, open_probe
from conformance.dut.simulator import Fault, Simulator
from conformance.oracle.verdicts import CaseResult
from conformance.pytest_plugin.robot_client import Client
from conformance.report.run_report import Report
from spec.protocol import Protocol

SIM = "sim"


class Bench:
    """A port, `sim` or an emulated board, for one run of the suite and any number of clients.

    Nothing is opened before `open`. `close` stops a run that still goes, and homes. `order` has the
    ids of the cases and their places in a run; `surprises` gets the results that are none of them.
    """

    def __init__(
        self,
        protocol: Protocol,
        target: str,
        *,
        options: Options,
        settings: LineSettings,
        probe: str | None = None,
        fault: Fault | None = None,
    ) -> None:
        self.protocol = protocol
        self.target = target
        self.options = options
        self._board = board_named(target)
        self.virtual = target == SIM or bool(self._board and self._board.virtual)
        self.report: Report | None = None
        cases = select_cases(protocol, options)
        self.order = {case.id: at for at, case in enumerate((*always(protocol), *cases))}
        self._cases = cases
        self._settings = settings
        self.own_probe = self._board.kind if self._board else SIM if self.virtual else None
        self._probe_name = self.own_probe or probe or "none"
        self._fault = fault
        self._stack = ExitStack()
        self._stopper = Stopper()
        self._port: Port | None = None
        self._probe: Probe | None = None
        self._power: Power | None = None
        self._thread: threading.Thread | None = None
        # Ctrl-C may come at any moment: its get() can be interrupted, which a condition's cannot.
        self._news: SimpleQueue[CaseResult | None] = SimpleQueue()
        self._over = True
        self._results: dict[str, CaseResult] = {}
        self.surprises: list[CaseResult] = []
        self.told_why = False
        self._broken: BaseException | None = None

    @property
    def device(self) -> dict[str, Any]:
        """What a report says about the link."""
        about = {"line": str(self._settings), "probe": self._probe_name}
        if self.virtual:
            fault = self._fault.name if self._fault else None
            return {"kind": "virtual", **about, "fault": fault}
        return {"kind": "port", **about}

    def seconds(self, ids: Collection[str]) -> float:
        """About how long a run of these cases takes on a port, in s."""
        chosen = [case for case in self._cases if case.id in ids]
        return estimated_seconds(self.protocol, chosen, self.options)

    def open(self, confirm: Callable[[], None]) -> None:
        """Open port and probe, once; then `confirm`, which raises if the robot may not move.

        An emulated board moves nothing: nobody is asked. Raises LinkError, ProbeError and
        EmulatorError, in one sentence.
        """
        if self.virtual:
            with self._device():  # whether there is one
                return
        if self._port is not None:
            return
        if self._board:
            from conformance.dut.boards.qemu import running

            board = running(self._board.firmware, self._settings)
            self._port, robot = self._stack.enter_context(board)
            self._probe, self._power = robot, robot.power_cycle
            return
        if self._probe_name == "ask":
            raise ProbeError("--robot-probe ask cannot be used under pytest; run bilprov conform")
        self._port = self._stack.enter_context(open_port(self.target, self._settings))
        self._probe = open_probe(self._probe_name, self._port)
        if self._probe:
            self._stack.callback(self._probe.close)
        confirm()

    # -- the run ----------------------------------------------------------------------------------

    def start(self, ids: Collection[str]) -> None:
        """Begin the run of these cases, in the suite's order. More than once is as good as once."""
        if self._thread is None:
            options = self.options
            if self.order.keys() - set(ids):
                options = replace(options, only=tuple(ids), shard=None)
            self._thread = threading.Thread(target=self._run, args=(options,), name="conformance")
            self._over = False
            self._thread.start()

    def result(self, ident: str) -> CaseResult | None:
        """A case's result once it is final; None when the run has ended without one.

        Raises what broke the run, if the kit did.
        """
        while ident not in self._results and not self._over:
            self._take()
        if ident not in self._results and self._broken:
            raise self._broken
        return self._results.get(ident)

    def why_not(self, ident: str) -> str:
        """Why a case has no result although the run has ended; "" where it was not needed."""
        if ident in self._results or self.report is None:
            return ""
        return self.report.unusable or self.report.ended

    def finish(self) -> None:
        """Wait for the end of the run."""
        while not self._over:
            self._take()

    def stop(self) -> None:
        """End a run that still goes; the robot is homed, and a second Ctrl-C does not hinder it."""
        with undisturbed(again=False):
            if not self._over:
                self._stopper.stop()
            self.finish()

    def _take(self) -> None:
        """The next result of the run, or its end."""
        result = self._news.get()
        if result is None:
            self._over = True
            return
        self._results[result.id] = result
        if result.id not in self.order:
            self.surprises.append(result)

    def begin(self, ident: str) -> None:
        """A case begins (as a watcher of the run)."""

    def end(self, result: CaseResult) -> None:
        """A case is final (as a watcher of the run)."""
        self._news.put(result)

    def _run(self, options: Options) -> None:
        try:
            self.report = self._conform(options)
        except BaseException as error:
            self._broken = error
        self._news.put(None)

    def _conform(self, options: Options) -> Report:
        if self.virtual:
            with self._device() as device:
                return conform(
                    device,
                    grammar=self.protocol,
                    options=options,
                    watcher=self,
                    interrupted=lambda: self._stopper.stopped,
                    name=self.target,
                    probe=self._probe_name,
                    fault=self._fault.name if self._fault else None,
                )
        assert self._port is not None, "open() comes first"
        return conform_port(
            self._port,
            self._probe,
            self._probe_name,
            grammar=self.protocol,
            options=options,
            stop=self._stopper.fileno(),
            interrupted=lambda: self._stopper.stopped,
            watcher=self,
            power=self._power,
            name=self.target,
        )

    @contextmanager
    def _device(self) -> Iterator[Device]:
        """What runs in virtual time, at its power-on."""
        if self._board is None:
            yield Simulator(self.protocol, self._fault)
            return
        from conformance.dut.boards.simavr import SimavrBoard

        with closing(SimavrBoard(self._board.firmware)) as board:
            yield board

    # -- clients ----------------------------------------------------------------------------------

    @contextmanager
    def client(self) -> Iterator[Client]:
        """A client, homed before and after. A run that still goes is waited for.

        Raises RobotError where the robot does not let itself be homed.
        """
        self.finish()
        with ExitStack() as stack:
            link: Link
            if self.virtual:
                device = stack.enter_context(self._device())
                link, sees = VirtualLink(device, self._settings.byte_time), True
            else:
                assert self._port is not None, "open() comes first"
                link = PortLink(self._port, self._probe, self._stopper.fileno())
                sees = self._probe is not None and not self._probe.sparse
            client = Client(self.protocol, link, sees=sees)
            client.home()
            try:
                yield client
            finally:
                with undisturbed(again=True):
                    client.home()

    def close(self) -> None:
        """Stop a run that still goes and give the port up; more than once is as good as once."""
        self.stop()
        self._stack.close()
        self._stopper.close()
