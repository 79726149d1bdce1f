"""A robot to talk to in a test: an instruction out, its answer back, a look through the probe.

It stands on a link (`conformance.drive.Link`), so a port in real time and a simulator in virtual
time are the same to a test.
"""

from __future__ import annotations

from analyzer.client.driver import Answer as Answer
from analyzer.client.errors import RobotError as RobotError
from analyzer.client.robot import Instructions
from analyzer.decode.pairing import MILLISECOND
from analyzer.transport.wire import Heard as Answers
from captures.schemas import Look
from conformance.dut.link import Link
from conformance.dut.operations import Ask, Heard, Listen, See, Seen, Send
from conformance.runner.run import Ended
from spec.protocol import Protocol

_SETTLE = 2 * MILLISECOND


class Client(Instructions):
    """One robot on a link, driven as a `Robot` is. `sees` tells whether a probe looks at it.

    Nothing is sent until `home` or an instruction is called. Every method raises RobotError where
    the robot does not answer, answers unasked, or cannot be reached any more.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        self._link_wire = LinkWire(link)
        super().__init__(protocol, self._link_wire)
        self.sees = sees

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to look through; see --robot-probe")
        return self._link_wire.look()

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        Speed and LED stay as they were. The probe, if there is one, must see it stand still.
        """
        super().home()
        self._require_still(round(self.protocol.timing.stop_longest * MILLISECOND))

    def _require_still(self, patience: int) -> None:
        """Link and probe are two lines: a look may be a little older than the answer."""
        wire = self._link_wire
        until = wire.now + patience
        while self.sees and self.look().moving:
            wire.listen(None, _SETTLE)
            if wire.now >= until:
                raise RobotError("the robot still moves although it was told to stop")


class LinkWire:
    """The wire that a link is (`analyzer.wire.Wire`); `now` is the time of its last listening."""

    def __init__(self, link: Link) -> None:
        self.now = 0
        self._link = link

    def send(self, data: bytes) -> int:
        """Send bytes; the time (ns) when the last one had gone. Raises RobotError."""
        sent = self._do(Send(data))
        assert isinstance(sent, int)
        return sent

    def listen(self, count: int | None, patience: int) -> Answers:
        """What came until there were `count`, or `patience` ns were over. Raises RobotError."""
        heard = self._do(Listen(count, patience))
        assert isinstance(heard, Heard)
        self.now = heard.now
        return heard.answers

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError."""
        seen = self._do(See())
        assert isinstance(seen, Seen)
        return seen.look

    def _do(self, ask: Ask) -> int | Heard | Seen:
        try:
            return self._link.do(ask)
        except Ended as ended:
            raise RobotError(str(ended)) from ended
