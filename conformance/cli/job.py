"""Runs the suite for the command line, in virtual time or on a port, with a bar and a recording."""

from __future__ import annotations

import time
from contextlib import ExitStack

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.replay.recorder import session_metadata
from bilprov.analyzer.transport.line_settings import line_settings, timeout_in_ns
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.errors import CaptureError
from bilprov.conformance.api import Options, conform, conform_port
from bilprov.conformance.cli.progress import Progress
from bilprov.conformance.dut.boards.target import BoardName
from bilprov.conformance.dut.fault import CONFORMING
from bilprov.conformance.dut.link import Device
from bilprov.conformance.dut.power import Power
from bilprov.conformance.dut.probes import Probe
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.recorder import RunRecorder
from bilprov.spec.protocol import Protocol

SIM = "sim"


class ConformRun:
    """One run of the suite with the command line's options, a progress bar and a recording."""

    def __init__(
        self, protocol: Protocol, options: Options, record: str | None, power: Power | None
    ) -> None:
        self._power = power
        self._protocol = protocol
        self._options = options
        self._record = record
        self._tap: RunRecorder | None = None

    @property
    def broken(self) -> CaptureError | None:
        """Why the recording ended before the run did, None if it did not."""
        return self._tap.broken if self._tap else None

    def on_simulator(self, stack: ExitStack, device: Simulator, count: int) -> Report:
        """Run the built-in simulator, in virtual time."""
        fault = None if device.fault is CONFORMING else device.fault.name
        return self._in_virtual_time(stack, device, count, SIM, SIM, fault)

    def on_board(self, stack: ExitStack, board: BoardName, name: str, count: int) -> Report:
        """Run an emulated board: it is its own probe, and nothing moves. Raises EmulatorError."""
        if board.virtual:
            from bilprov.conformance.dut.boards.simavr import SimavrBoard

            device = SimavrBoard(board.firmware)
            stack.callback(device.close)
            report = self._in_virtual_time(stack, device, count, name, board.kind)
            if device.crashed:
                note(f"{board.firmware} crashed: the board has been silent since")
            return report
        from bilprov.conformance.dut.boards.qemu import running

        settings = line_settings(self._protocol, None, None, None)
        port, robot = stack.enter_context(running(board.firmware, settings))
        self._power = robot.power_cycle
        return self.on_port(stack, port, robot, board.kind, count, name)

    def _in_virtual_time(
        self,
        stack: ExitStack,
        device: Device,
        count: int,
        name: str,
        probe: str,
        fault: str | None = None,
    ) -> Report:
        stopper = stack.enter_context(Stopper())
        line = line_settings(self._protocol, None, None, None)
        tap = self._recorder(stack, name, str(line))
        return conform(
            device,
            grammar=self._protocol,
            options=self._options,
            listener=stack.enter_context(Progress(count, tap)),
            tap=tap,
            interrupted=lambda: stopper.stopped or str(self.broken or ""),
            name=name,
            probe=probe,
            fault=fault,
        )

    def on_port(
        self,
        stack: ExitStack,
        port: Port,
        probe: Probe | None,
        probe_name: str,
        count: int,
        name: str | None = None,
    ) -> Report:
        """Run on an open port in real time; the robot moves."""
        stopper = stack.enter_context(Stopper())
        tap = self._recorder(stack, name or port.name, str(port.settings))
        return conform_port(
            port,
            probe,
            probe_name,
            grammar=self._protocol,
            options=self._options,
            stop=stopper.fileno(),
            interrupted=lambda: stopper.stopped or str(self.broken or ""),
            listener=stack.enter_context(Progress(count, tap, shown=probe_name != "ask")),
            tap=tap,
            power=self._power,
            name=name,
        )

    def _recorder(self, stack: ExitStack, device: str, line: str) -> RunRecorder | None:
        if self._record is None:
            return None
        timeout = timeout_in_ns(self._protocol, self._options.truncation_timeout)
        metadata = session_metadata(
            self._protocol,
            ports={"device": device},
            line=line,
            timeout=timeout,
            skew=0,
            heard=("host", "device"),
        )
        session = Session(self._protocol, timeout=timeout, skew=0)
        recorder = RunRecorder(self._record, session, time.time_ns(), metadata)
        self._tap = stack.enter_context(recorder)
        return self._tap
