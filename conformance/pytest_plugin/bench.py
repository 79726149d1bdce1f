"""Runs the suite in a thread for pytest, or gives clients to tests; never both at once.

The run has a thread of its own, so that the tests do not disturb its timing, and hands out each
result as it becomes final. However it ends, the robot is homed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import Stopper, undisturbed
from bilprov.conformance.api import (
    Options,
    conform,
    conform_port,
    estimated_seconds,
    opening_and_reading_cases,
    select_cases,
)
from bilprov.conformance.dut.boards.target import board_named
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.link import Device, Link
from bilprov.conformance.dut.port_link import PortLink
from bilprov.conformance.dut.power import Power
from bilprov.conformance.dut.probes import Probe, ProbeError, open_probe
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.conformance.oracle.verdicts import CaseResult
from bilprov.conformance.pytest_plugin.robot_client import Client
from bilprov.conformance.report.run_report import Report
from bilprov.spec.protocol import Protocol

SIM = "sim"


class SuiteThread:
    """One run of the suite, and any number of clients, on a port, `sim` or an emulated board.

    Nothing is opened before `open`. `close` stops a run that is still going, and homes. `order` has
    the ids of the cases and their places in a run; `unplanned` gets the results of other cases.
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
        cases = select_cases(protocol, options, settings)
        self.order = {
            case.id: at for at, case in enumerate((*opening_and_reading_cases(protocol), *cases))
        }
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
        # Ctrl-C may come at any moment: SimpleQueue.get can be interrupted, a condition cannot.
        self._results_queue: SimpleQueue[CaseResult | None] = SimpleQueue()
        self._over = True
        self._results: dict[str, CaseResult] = {}
        self.unplanned: list[CaseResult] = []
        self.told_why = False
        self._broken: BaseException | None = None

    @property
    def device(self) -> dict[str, Any]:
        """The link as a report describes it."""
        about = {"line": str(self._settings), "probe": self._probe_name}
        if self.virtual:
            fault = self._fault.name if self._fault else None
            return {"kind": "virtual", **about, "fault": fault}
        return {"kind": "port", **about}

    def seconds(self, ids: Collection[str]) -> float:
        """About how long a run of these cases takes on a port, in s."""
        chosen = [case for case in self._cases if case.id in ids]
        return estimated_seconds(self.protocol, chosen, self.options, self._settings)

    def open(self, confirm: Callable[[], None]) -> None:
        """Open port and probe, once; then call `confirm`, which raises if the robot may not move.

        It is not called for the simulator or an emulated board, which move nothing. Raises
        LinkError, ProbeError and EmulatorError, in one sentence.
        """
        if self.virtual:
            with self._device():  # raises if the firmware cannot be run
                return
        if self._port is not None:
            return
        if self._board:
            from bilprov.conformance.dut.boards.qemu import running

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
        """Begin the run of these cases, in the suite's order. Only the first call has an effect."""
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
        """Why a case has no result although the run has ended; "" if the run did not need it."""
        if ident in self._results or self.report is None:
            return ""
        return self.report.unusable or self.report.ended

    def finish(self) -> None:
        """Wait for the end of the run."""
        while not self._over:
            self._take()

    def stop(self) -> None:
        """End a run that is still going; homes the robot, and ignores a second Ctrl-C meanwhile."""
        with undisturbed(again=False):
            if not self._over:
                self._stopper.stop()
            self.finish()

    def _take(self) -> None:
        """Wait for the next result of the run, or its end, and store it."""
        result = self._results_queue.get()
        if result is None:
            self._over = True
            return
        self._results[result.id] = result
        if result.id not in self.order:
            self.unplanned.append(result)

    def begin(self, ident: str) -> None:
        """A case begins (as a run listener)."""

    def end(self, result: CaseResult) -> None:
        """A case is final (as a run listener)."""
        self._results_queue.put(result)

    def _run(self, options: Options) -> None:
        try:
            self.report = self._conform(options)
        except BaseException as error:
            self._broken = error
        self._results_queue.put(None)

    def _conform(self, options: Options) -> Report:
        if self.virtual:
            with self._device() as device:
                return conform(
                    device,
                    grammar=self.protocol,
                    options=options,
                    listener=self,
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
            listener=self,
            power=self._power,
            name=self.target,
        )

    @contextmanager
    def _device(self) -> Iterator[Device]:
        """The device that runs in virtual time, just after power-on."""
        if self._board is None:
            yield Simulator(self.protocol, self._fault)
            return
        from bilprov.conformance.dut.boards.simavr import SimavrBoard

        with closing(SimavrBoard(self._board.firmware)) as board:
            yield board

    # -- clients ----------------------------------------------------------------------------------

    @contextmanager
    def client(self) -> Iterator[Client]:
        """A client of the robot, which is homed before and after. Waits for the end of a run.

        Raises RobotError where the robot cannot be homed.
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
                sees = self._probe is not None and not self._probe.costly
            client = Client(self.protocol, link, sees=sees)
            client.home()
            try:
                yield client
            finally:
                with undisturbed(again=True):
                    client.home()

    def close(self) -> None:
        """Stop a run that is still going and close the port; may be called more than once."""
        self.stop()
        self._stack.close()
        self._stopper.close()
