"""The client of the fixture `robot`: sends instructions, reads answers, looks through the probe.

It uses a link (`conformance.dut.link.Link`), so a test works alike on a port in real time and on a
simulator in virtual time.
"""

from __future__ import annotations

from typing import TypeVar

from bilprov.analyzer.client.driver import RobotError
from bilprov.analyzer.client.robot import Instructions
from bilprov.analyzer.client.wire import Heard as Answers
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.dut.link import Link
from bilprov.conformance.dut.operations import (
    Ended,
    Listen,
    Observation,
    Observe,
    Operation,
    Received,
    Send,
)
from bilprov.spec.protocol import Protocol

_SETTLE = 2 * MS
R = TypeVar("R", int, Received, Observation)


class Client(Instructions):
    """One robot on a link, driven as a `Robot` is. `sees` says whether there is a probe to look.

    Nothing is sent until `home` or an instruction is called. Every method raises RobotError where
    the robot does not answer, sends an unsolicited answer, or cannot be reached any more.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        self._link_wire = LinkWire(link)
        super().__init__(protocol, self._link_wire)
        self.sees = sees

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to observe the robot; see --robot-probe")
        return self._link_wire.look()

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        Speed and LED stay as they were. The probe, if there is one, must see it stand still.
        """
        super().home()
        self._require_still(round(self.protocol.timing.stop_longest * MS))

    def _require_still(self, patience: int) -> None:
        """Look until the robot stands still; raise RobotError after `patience` ns.

        Link and probe are two lines: a look may be a little older than the answer.
        """
        wire = self._link_wire
        until = wire.now + patience
        while self.sees and self.look().moving:
            wire.listen(None, _SETTLE)
            if wire.now >= until:
                raise RobotError("the robot still moves although it was sent a stop")


class LinkWire:
    """A link as a wire (see `analyzer.client.wire`); `now` (ns) is when it last listened."""

    def __init__(self, link: Link) -> None:
        self.now = 0
        self._link = link

    def send(self, data: bytes) -> int:
        """Send bytes; returns the time (ns) when the last one had gone. Raises RobotError."""
        return self._do(Send(data), int)

    def listen(self, count: int | None, patience: int) -> Answers:
        """The answers until there are `count` or `patience` ns are over. Raises RobotError."""
        heard = self._do(Listen(count, patience), Received)
        self.now = heard.now
        return heard.answers

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError."""
        return self._do(Observe(), Observation).look

    def _do(self, operation: Operation, kind: type[R]) -> R:
        try:
            reply = self._link.do(operation)
        except Ended as ended:
            raise RobotError(str(ended)) from ended
        assert isinstance(reply, kind)
        return reply
