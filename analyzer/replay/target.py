"""The device that bytes are sent to: sends, reads and decodes, and homes the device at the end."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence

import msgspec

from bilprov.analyzer.client.wire import PortWire, home, home_once, stops
from bilprov.analyzer.decode.records import Record, written_state
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.closing import Closing
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.motion import Motion, State
from bilprov.spec.protocol import Protocol


class Target(Closing):
    """One device on an open port; a context manager that homes it on every way out.

    Before Ctrl-Z suspends the process it is stopped, which is also a request to `stopper`.

    `timeout` (ns) is the longest pause inside a frame as it is sent here. `heard` is called with
    each record. `state` is what the instructions so far predict. `answered_stops` tells whether the
    device answered the last homing: one that did not may still be moving.
    """

    def __init__(
        self,
        protocol: Protocol,
        port: Port,
        timeout: int,
        stopper: Stopper,
        heard: Callable[[Record], object],
    ) -> None:
        self.state = written_state(protocol.power_on)
        self.answered_stops = False
        self._heard = heard
        self._protocol = protocol
        self._port = port
        self._wire = PortWire(port)
        self._stopper = stopper
        self._session = Session(protocol, timeout=timeout, skew=0)
        self._start = time.monotonic_ns()
        self._halted = False  # by stops that the session does not know of
        stopper.before_suspending(self._halt)

    def begin(self) -> None:
        """Home the device: stopped, at a frame boundary. Raises LinkError if it never answers."""
        self.answered_stops = home(self._protocol, self._wire, lambda: self._stopper.stopped)
        if not self.answered_stops and not self._stopper.stopped:
            raise LinkError(
                f"nobody answers at {self._port.name}; is the robot on, and is it the right port?"
            )
        self._start = time.monotonic_ns()

    def send(self, data: bytes) -> None:
        """Send host bytes. Raises LinkError."""
        self.pump(0)
        self._show(self._session.feed(Chunk(self._now(), "host", data)))
        self._port.write(data)

    def pump(self, seconds: float, also: Sequence[int] = ()) -> list[int]:
        """Read what the device sends, waiting at most `seconds` for that.

        A stop ends the waiting, and so does one of the descriptors `also`; those of them that are
        readable are returned. Raises LinkError.
        """
        now = self._now()
        waited = [self._stopper.fileno(), *also]
        _, ready = wait_readable([self._port], max(0.0, seconds), waited)
        data = self._port.read()
        if self._halted:  # these are answers to the stops
            data = b""
        records = self._session.feed(Chunk(self._now(), "device", data)) if data else []
        self._show([*records, *self._session.advance(now)])
        return [descriptor for descriptor in also if descriptor in ready]

    def wait(self, seconds: float) -> None:
        """Let time pass (s), reading meanwhile; Ctrl-C ends it. Raises LinkError."""
        until = time.monotonic() + seconds
        while not self._stopper.stopped and (left := until - time.monotonic()) > 0:
            self.pump(left)

    def settle(self) -> None:
        """Read until each instruction is answered or counts as unanswered. Raises LinkError."""
        while (due := self._session.deadline) is not None and not self._stopper.stopped:
            self.pump(min(0.1, (due - self._now()) / 1e9))

    def finish(self) -> None:
        """End the run after the last byte: wait for the answers and record what is left.

        Raises LinkError.
        """
        self.settle()
        self.wait(self._protocol.timing.answer_deadline / 1000)  # for answers too many
        self._show(self._session.finish())

    def home(self) -> None:
        """Stop the device in mid-run; what follows is decoded as after a stop. Raises LinkError."""
        self._show(self._session.finish())
        self.answered_stops = home_once(self._protocol, self._wire)
        self._halted = False
        was = self.state
        before = State(Motion(was.motion), was.speed, was.steering, was.led)
        self.state = written_state(self._protocol.stop.effect.apply(before))
        saved = self._session.saved()
        if saved is not None:  # frame boundaries are known: all that was sent came from here
            self._session.resume(
                msgspec.structs.replace(saved, time=self._now(), state=self.state, waiting=())
            )

    def close(self) -> None:
        """Home the device and close its port; further calls do nothing."""
        with contextlib.suppress(LinkError):  # the port is lost: nothing can be sent to it
            # A second Ctrl-C changes nothing here: the device is brought to a stop first.
            self.answered_stops = home_once(self._protocol, self._wire)
        self._port.close()

    def _halt(self) -> None:
        self._halted = True
        with contextlib.suppress(LinkError):
            self._port.write(stops(self._protocol))

    def _show(self, records: Iterable[Record]) -> None:
        for record in records:
            self.state = record.state
            self._heard(record)

    def _now(self) -> int:
        return time.monotonic_ns() - self._start


def scaled_timeout(timeout: int, rate: float) -> int:
    """The truncation time-out (ns) of a recording that is sent `rate` times as fast."""
    return max(MS, round(timeout / rate)) if rate else timeout
