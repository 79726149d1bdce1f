"""Lines that delay bytes by different times, and devices that are stopped now and then.

Runs over them take place in virtual time, with the timers of a real line.
"""

from __future__ import annotations

from typing import Any

from bilprov.analyzer.taps.impairment import ImpairedDirection, LineFaults
from bilprov.captures.schemas import Look
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.link import Device, Environment, Link, LinkListener, Observability
from bilprov.conformance.dut.operations import Observation, Observe, Operation, Reply
from bilprov.conformance.dut.target import Target
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.protocol import Protocol

BYTE_TIME = 86_806  # ns at 115,200 8N1


class JitteryDevice:
    """A device behind a line that holds each byte up by `delay` to `delay` + `jitter` ns, seeded.

    It does so in both directions, and keeps the order of the bytes.
    """

    def __init__(self, device: Device, jitter: int, seed: int, delay: int = 0) -> None:
        self._device = device
        faults = LineFaults(delay=delay, jitter=jitter)
        self._inward = ImpairedDirection(faults, seed, "to the device")
        self._outward = ImpairedDirection(faults, seed, "from the device")

    def receive(self, data: bytes, now: int) -> None:
        self._deliver(now)
        self._inward.put(data, now)
        self._deliver(now)

    def advance(self, now: int) -> bytes:
        self._deliver(now)
        return self._outward.take(now)

    def deadline(self) -> int | None:
        due = (self._inward.deadline, self._outward.deadline, self._device.deadline())
        return min((time for time in due if time is not None), default=None)

    def look(self, now: int) -> Look:
        self._deliver(now)
        return self._device.look(now)

    def _deliver(self, now: int) -> None:
        while (arrives := self._inward.deadline) is not None and arrives <= now:
            self._answers(arrives)
            self._device.receive(self._inward.take(arrives), arrives)
        self._answers(now)

    def _answers(self, until: int) -> None:
        """Take the device's answers, each at the time at which it sends it."""
        while (due := self._device.deadline()) is not None and due <= until:
            self._outward.put(self._device.advance(due), due)
            if self._device.deadline() == due:
                break
        self._outward.put(self._device.advance(until), until)


class StoppedDevice:
    """A device whose process stands still for `stop` ns of every `period`: bytes wait meanwhile."""

    def __init__(self, device: Device, stop: int, period: int = 1_000_000_000) -> None:
        self._device = device
        self._stop = stop
        self._period = period
        self._waiting = b""

    def runs_at(self, now: int) -> int:
        """When (ns), from `now` on, it runs."""
        phase = now % self._period
        return now if phase >= self._stop else now - phase + self._stop

    def receive(self, data: bytes, now: int) -> None:
        self._wake(now)
        self._waiting += data
        self._wake(now)

    def advance(self, now: int) -> bytes:
        self._wake(now)
        return b"" if self.runs_at(now) > now else self._device.advance(now)

    def deadline(self) -> int | None:
        due = self._device.deadline()
        if self._waiting:
            return self.runs_at(self._last)
        return None if due is None else self.runs_at(due)

    def look(self, now: int) -> Look:
        self._wake(now)
        return self._device.look(now)

    def _wake(self, now: int) -> None:
        self._last = now
        if self._waiting and self.runs_at(now) == now:
            data, self._waiting = self._waiting, b""
            self._device.receive(data, now)


class StoppedLink(VirtualLink):
    """A link whose probe stands still with its device, as that of one process does."""

    def __init__(self, device: StoppedDevice, tap: LinkListener | None = None) -> None:
        super().__init__(device, BYTE_TIME, tap)
        self._stopped = device

    def do(self, operation: Operation) -> Reply:
        asked = self.now
        if isinstance(operation, Observe):
            self._pass(self._stopped.runs_at(asked))
        reply = super().do(operation)
        return Observation(asked, self.now, reply.look) if isinstance(reply, Observation) else reply


class Notes(RunListener):
    """Keeps the notes of a run."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def note(self, sentence: str) -> None:
        self.told.append(sentence)


def run_on_line(
    protocol: Protocol, device: Any, *listeners: RunListener, **options: Any
) -> tuple[Report, float]:
    """Judge a device with the timers of a real line: the report, and how long (s) the run took."""
    links: list[VirtualLink] = []

    def connect(tap: LinkListener | None) -> Link:
        stopped = isinstance(device, StoppedDevice)
        links.append(StoppedLink(device, tap) if stopped else VirtualLink(device, BYTE_TIME, tap))
        return links[0]

    about = {"kind": "port", "byte_ns": BYTE_TIME, "latency_ns": 0, "look_ns": 0}
    seen = Observability(available=True)
    target = Target(protocol, Environment(False, seen, False, "a line", about), connect)
    report = run_suite(target, Options(**options), listeners, logged=False)
    return report, links[0].now / 1e9
