"""A bridge between host and device: passes every byte on unchanged and yields it as a chunk."""

from __future__ import annotations

from collections.abc import Sequence

from bilprov.analyzer.taps.source import Source
from bilprov.analyzer.transport.forward import Forward
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import wait_readable
from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.schemas import Chunk, Direction, Line

_RETRY = 0.005  # s between attempts to forward bytes that a peer did not take


class Bridge(Source):
    """A pty for the host program, connected to the device's port; every byte is passed on.

    The host program opens `served`; its settings there (baud rate, DTR) do not reach the device.
    It may open the pty at any time. A side that does not read never delays the other side or the
    recording: bytes it does not take for a second are dropped, though they are still recorded. A
    Line event `gap` reports this on the tap whose bytes were dropped. `ended` is true once the
    device is lost. `close` also closes the port.
    """

    one_clock = True
    attached = False  # no traffic has passed yet through a pty that was just made

    def __init__(self, port: Port) -> None:
        super().__init__({"device": port})
        self._pty = open_pty()
        self.served = self._pty.name
        self.names = {"bridge": port.name, "pty": self.served}
        self._port = port
        self._to_device = Forward(port.write_some, "the device does not read")
        self._to_host = Forward(self._pty.write_some, "the host program does not read")

    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> list[Chunk | Line]:
        """Return the new events, as every source does, and pass their bytes on."""
        events: list[Chunk | Line] = []
        if self.ended:
            return events
        if self._to_device.owed or self._to_host.owed:
            timeout_s = _RETRY if timeout_s is None else min(timeout_s, _RETRY)
        ready, _ = wait_readable([self._port], timeout_s, [self._pty.master, *also])
        said = self._pty.read()
        if said:
            events.append(Chunk(self.now(), "host", said))
        self._hand_on(self._to_device, said, "host", events)
        answered = self._read("device", events) if ready else b""
        self._hand_on(self._to_host, answered, "device", events)
        self._count(events)
        return events

    def close(self) -> None:
        """Close the pty and the port; further calls do nothing."""
        self._pty.close()
        super().close()

    def _hand_on(
        self, forward: Forward, data: bytes, tap: Direction, events: list[Chunk | Line]
    ) -> None:
        dropped = forward.push(data, self.now())
        if dropped:
            events.append(Line(self.now(), "gap", tap, dropped))
