"""One run as the command line asks for it: in virtual time or on a port, watched and recorded."""

from __future__ import annotations

import time
from contextlib import ExitStack

from analyzer.decode.session import Session
from analyzer.options import line_settings, note, timeout_in_ns
from analyzer.replay.recorder import session_metadata
from analyzer.transport.port import Port
from analyzer.transport.signals import Stopper
from captures.errors import CaptureError
from conformance.api import Options, conform, conform_port
from conformance.cli.progress import Progress
from conformance.dut.boards.target import BoardName
from conformance.dut.link import Device
from conformance.dut.power import Power
from conformance.dut.probes import Probe
from conformance.dut.simulator import CONFORMING, Simulator
from conformance.report.run_report import Report
from conformance.runner.listeners.recorder import RunRecorder
from spec.protocol import Protocol

SIM = "sim"


class Job:
    """One run as the command line asks for it, with its progress bar and its recording."""

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
            from conformance.dut.boards.simavr import SimavrBoard

            device = SimavrBoard(board.firmware)
            stack.callback(device.close)
            report = self._in_virtual_time(stack, device, count, name, board.kind)
            if device.crashed:
                note(f"{board.firmware} crashed: the board has been silent since")
            return report
        from conformance.dut.boards.qemu import running

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
            watcher=stack.enter_context(Progress(count, tap)),
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
        """Run in real time; the robot moves."""
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
            watcher=stack.enter_context(Progress(count, tap, shown=probe_name != "ask")),
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
