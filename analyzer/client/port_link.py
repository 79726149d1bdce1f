"""A link over a real port, in real time, which reads the port during every wait; power switches."""

from __future__ import annotations

import select
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bilprov.analyzer.client import operations
from bilprov.analyzer.client.probes import Probe, ProbeError
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.replug import Place, opened_again
from bilprov.analyzer.transport.signals import Stopper

_PARTING = 5.0  # s that a run which was stopped waits for a lost port, to home the robot there


@dataclass(eq=False)
class PortLink:
    """Does operations on a port and, where there is one, a probe, in real time.

    A stop that `stopper` is asked for ends what is waited for, once: the robot has to be homed
    after that. `tap` is told what passes. `power` is a shell command that switches the robot off
    and on. A port that is lost is waited for `reconnect` s (`transport.replug`), and the operation
    then ends with Reconnected. `clock` gives the time in ns.
    """

    port: Port
    probe: Probe | None = None
    stopper: Stopper | None = None
    tap: operations.LinkListener | None = None
    power: str | None = None
    reconnect: float = 0.0
    clock: Callable[[], int] = time.monotonic_ns

    def __post_init__(self) -> None:
        self._stopping = self.stopper is None
        self._place = Place(self.port.name) if self.reconnect else None
        self._start = self.clock()
        self._heard: list[tuple[int, int]] = []
        self._sent = 0
        self._asked = False  # whether the reply to a look is still to come

    def now(self) -> int:
        """The time in ns since the link was made."""
        return self.clock() - self._start

    def do(self, operation: operations.Operation) -> operations.Reply:
        """Do one operation. Raises Ended when the port, the probe or the power switch fails.

        It is Reconnected where the port was lost and is there again.
        """
        try:
            match operation:
                case operations.PowerCycle():
                    return self._power_cycle()
                case operations.Send(data):
                    return self._send(data)
                case operations.Listen(count, patience):
                    return self._listen(count, patience)
                case operations.Observe():
                    return self._see()
        except LinkError as error:
            raise self._lost(error) from error
        except ProbeError as error:
            self._asked = False  # no reply is waited for
            raise operations.Ended(str(error), error=True, line_works=True) from error

    def _lost(self, error: LinkError) -> operations.Ended:
        """Wait for a lost port where that was asked for; returns how that ended."""
        lost = self.now()
        if self._place is None:
            return operations.Ended(str(error), error=True, line_works=False)
        self.port.close()
        self._heard.clear()
        # A stop that was asked for before cannot be asked for again.
        longest = min(self.reconnect, _PARTING) if self._stopping else self.reconnect
        again = opened_again(self._place, self.port.settings, error, self._to_stop, longest)
        if again is None and self._to_stop():
            return operations.Ended("interrupted", error=False, line_works=False)
        if again is None:
            sentence = f"{error}, and it was not there again in {longest:g} s (--reconnect)"
            return operations.Ended(sentence, error=True, line_works=False)
        self._place = Place(again.name)
        self.port.renew(again)
        now, asked, self._asked = self.now(), self._asked, False
        try:
            if asked and self.probe is not None:  # or the next look got this one's reply
                self.probe.look(self.now, asked=True)
        except ProbeError as broken:
            return operations.Ended(str(broken), error=True, line_works=True)
        after = f"it was there again after {(now - lost) / 1e9:.1f} s"
        return operations.Reconnected(f"{error}; {after}", lost, now)

    def _to_stop(self) -> bool:
        """Whether a stop is asked for that has not ended anything yet."""
        return not self._stopping and self.stopper is not None and self.stopper.stopped

    def _power_cycle(self) -> int:
        assert self.power is not None
        nothing = subprocess.DEVNULL
        try:  # it may take a minute
            subprocess.run(self.power, shell=True, check=True, timeout=60, stdin=nothing)
        except (OSError, subprocess.SubprocessError) as error:
            sentence = f"the power switch {self.power!r} did not work: {error}"
            raise operations.Ended(sentence, error=True, line_works=True) from error
        self._read()
        self._heard.clear()
        return self.now()

    def _send(self, data: bytes) -> int:
        self._read()
        begun = self.now()
        self.port.write(data)
        if self.tap:
            self.tap.sent(data, begun)
        self._sent = max(self.now(), begun + len(data) * self.port.byte_time)
        return self._sent

    def _listen(self, count: int | None, patience: int) -> operations.Received:
        until = max(self.now(), self._sent) + patience
        self._read()
        while True:
            now = self.now()
            enough = count is not None and len(self._heard) >= count
            if enough or now >= until or self._wait(until - now):
                break
        heard, self._heard = tuple(self._heard), []
        return operations.Received(heard, self.now())

    def _see(self) -> operations.Observation:
        assert self.probe is not None
        asked = self.now()
        self._asked = True
        look = self.probe.look(self.now, self._wait)
        self._asked = False
        if self.tap:
            self.tap.looked(look)
        return operations.Observation(asked, self.now(), look)

    def attend(self, seconds: float, also: Sequence[int]) -> list[int]:
        """Read what comes, waiting at most `seconds` for that or for a descriptor.

        Returns those of the descriptors `also` that are readable. Raises LinkError.
        """
        port = self.port.fileno()
        ready = select.select([port, *also], [], [], max(seconds, 0))[0]
        if port in ready:
            self._read(ready=True)
        return [descriptor for descriptor in also if descriptor in ready]

    def _wait(self, patience: int, other: int | None = None) -> bool:
        """Wait up to `patience` ns, reading the port; true if stopped or `other` is ready.

        Raises Ended where a stop comes before `other` is ready: a person may look for minutes.
        """
        stop = None if self._stopping or self.stopper is None else self.stopper.fileno()
        ready = self.attend(patience / 1e9, [fd for fd in (other, stop) if fd is not None])
        if stop in ready:
            self._stopping = True
            if other not in (None, *ready):
                raise operations.Ended("interrupted", error=False, line_works=True)
            return True
        return other is not None and other in ready

    def _read(self, *, ready: bool = False) -> None:
        data = self.port.read(ready=ready)
        if data:
            now = self.now()
            if self.tap:
                self.tap.received(data, now)
            room = operations.HELD_ANSWERS - len(self._heard)
            self._heard += [(now, byte) for byte in data[:room]]
