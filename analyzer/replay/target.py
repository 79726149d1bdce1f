"""The device that bytes are sent to: sends, reads and decodes, and homes the device at the end."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence

import msgspec

from bilprov.analyzer.client.operations import LinkListener, done, send
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.rest import Rest, nobody_words
from bilprov.analyzer.decode.records import HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.closing import Closing
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.protocol import Protocol


class Target(Closing, LinkListener):
    """One device on an open port; a context manager that homes it on every way out.

    Before Ctrl-Z suspends the process it is stopped, which is also a request to `stopper`.

    `timeout` (ns) is the longest pause inside a frame as it is sent here. `heard` is called with
    each record. A device that has driven `max_drive` s without a new instruction is stopped, which
    `driven_out` tells until the next one is sent; 0 is no limit. `state` is what the instructions
    so far predict. `answered_stops` tells whether the device answered the last homing: one that did
    not may still be moving.
    """

    def __init__(
        self,
        protocol: Protocol,
        port: Port,
        timeout: int,
        stopper: Stopper,
        heard: Callable[[Record], object],
        max_drive: float = 0.0,
    ) -> None:
        self.state = protocol.power_on
        self.answered_stops = False
        self.driven_out = False
        self._max_drive = max_drive
        self._instructed = 0.0  # when the last instruction was sent (s)
        self._heard = heard
        self._protocol = protocol
        self._rest = Rest(protocol)
        self._port = port
        self._link = PortLink(port, tap=self)
        self._stopper = stopper
        pause = Machine().least_pause(port.name)
        self._session = Session(protocol, timeout=timeout, skew=0, adapter_pause=pause)
        self._start = 0  # on the link's clock
        # Stops are under way that the session does not know of.
        self._homing = self._halted = False
        stopper.before_suspending(self._halt)

    def begin(self, *, homed: bool = True) -> None:
        """Home the device: stopped, at a frame boundary. Raises LinkError if it never answers.

        One that is not to be `homed` was just switched on.
        """
        if homed:
            self._home(patient=True)
            self.require_answer()
        self._start = self._link.now()

    def send(self, data: bytes) -> None:
        """Send host bytes. Raises LinkError."""
        self.pump(0)
        done(send(data), self._link)
        self.driven_out = False
        self._instructed = time.monotonic()

    def sent(self, data: bytes, t: int) -> None:
        """Bytes that go to the device."""
        if not self._homing:
            self._show(self._session.feed(Chunk(t - self._start, "host", data)))

    def received(self, data: bytes, t: int) -> None:
        """Bytes that came from it."""
        if not (self._homing or self._halted):  # else these are answers to the stops
            self._show(self._session.feed(Chunk(t - self._start, "device", data)))

    def pump(self, seconds: float, also: Sequence[int] = ()) -> list[int]:
        """Read what the device sends, waiting at most `seconds` for that.

        A stop ends the waiting, and so does one of the descriptors `also`; those of them that are
        readable are returned. A device that has driven too long is stopped. Raises LinkError.
        """
        now = self.now()
        limited = self._max_drive > 0 and self._protocol.directed(self.state)
        until = self._instructed + self._max_drive
        if limited:
            seconds = min(seconds, until - time.monotonic())
        ready = self._link.attend(seconds, [self._stopper.fileno(), *also])
        self._show(self._session.advance(now))
        if limited and time.monotonic() >= until:
            self.home()
            self.driven_out = True
        return [descriptor for descriptor in also if descriptor in ready]

    def wait(self, seconds: float) -> None:
        """Let time pass (s), reading meanwhile; Ctrl-C ends it, and so does the limit of driving.

        Raises LinkError.
        """
        until = time.monotonic() + seconds
        while not self.ended and (left := until - time.monotonic()) > 0:
            self.pump(left)

    def settle(self) -> None:
        """Read until each instruction is answered or counts as unanswered. Raises LinkError."""
        while (due := self._session.deadline) is not None and not self.ended:
            self.pump(min(0.1, (due - self.now()) / 1e9))

    def finish(self) -> None:
        """End the run after the last byte: wait for the answers and record what is left.

        Raises LinkError.
        """
        self.settle()
        self.wait(self._protocol.timing.answer_deadline / 1000)  # for answers too many
        self._show(self._session.finish())

    def home(self, *, patient: bool = False) -> None:
        """Stop the device in mid-run; what follows is decoded as after a stop. Raises LinkError.

        A `patient` homing waits for a device that may still boot.
        """
        self._show(self._session.finish())
        self._home(patient=patient)
        self.state = self._rest.after(self.state)
        saved = self._session.saved()
        if saved is not None:  # frame boundaries are known: all that was sent came from here
            self._session.resume(
                msgspec.structs.replace(saved, time=self.now(), state=self.state, waiting=())
            )

    def resume(self, port: Port, gap: str) -> None:
        """Go on at a port that was lost and is there again; first the device is homed.

        `gap` says in words what was. Raises LinkError if the port is lost again; whether the device
        answered, `require_answer` tells.
        """
        self._port.renew(port)
        self._show(self._session.feed(Line(self.now(), "reconnected", "device", gap)))
        self.home(patient=True)

    def now(self) -> int:
        """The time in ns since `begin`."""
        return self._link.now() - self._start

    @property
    def ended(self) -> bool:
        """Whether nothing more may be sent: it drove too long, or a stop was asked for."""
        return self.driven_out or self._stopper.stopped

    @property
    def driven_out_words(self) -> str:
        """Why the device was stopped in mid-run, in words; "" if it was not."""
        if not self.driven_out:
            return ""
        why = f"it has driven for {self._max_drive:g} s without a new instruction"
        return self.stopped_words(why)

    def stopped_words(self, why: str) -> str:
        """Why the device was homed, in words, and whether it answered that."""
        silent = f"the {self._protocol.device} does not answer the stops"
        return f"{'stopped' if self.answered_stops else silent}: {why}"

    def close(self) -> None:
        """Home the device and close its port; further calls do nothing."""
        # A second Ctrl-C changes nothing here: the device is brought to a stop first.
        with contextlib.suppress(LinkError):  # the port is lost: nothing can be sent to it
            self._home(patient=False)
        self._port.close()

    def _home(self, *, patient: bool) -> None:
        """Home the device, and note whether it answered, without a record of that."""
        self.answered_stops, self._homing = False, True
        rest = self._rest
        procedure = rest.patiently(lambda: self._stopper.stopped) if patient else rest.once()
        try:
            self.answered_stops = done(procedure, self._link)
        finally:
            self._homing = self._halted = False

    def require_answer(self) -> None:
        """Raise LinkError if the device did not answer the last homing, unless that was stopped."""
        if not self.answered_stops and not self._stopper.stopped:
            raise LinkError(nobody_words(self._protocol, self._port.name))

    def _halt(self) -> None:
        self._halted = True
        self._rest.halt(self._port)

    def _show(self, records: Iterable[Record]) -> None:
        for record in records:
            self.state = record.state
            if isinstance(record, HostRecord) and record.judgement is not None:
                self._rest.note(record.judgement.address)
            self._heard(record)


def scaled_timeout(timeout: int, rate: float) -> int:
    """The truncation time-out (ns) of a recording that is sent `rate` times as fast."""
    return max(MS, round(timeout / rate)) if rate else timeout
