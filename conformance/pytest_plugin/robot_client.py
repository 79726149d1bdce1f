"""The client of the fixture `robot`: sends instructions, reads answers, looks through the probe.

It uses a link (`analyzer.client.operations.Link`), so a test works alike on a port in real time and
on a simulator in virtual time.
"""

from __future__ import annotations

from typing import TypeVar

from bilprov.analyzer.client.driver import RobotError
from bilprov.analyzer.client.operations import Ended, Link, Procedure, drive, listen, observe
from bilprov.analyzer.client.robot import Instructions
from bilprov.captures.schemas import MS, Look
from bilprov.spec.protocol import Protocol

_SETTLE = 2 * MS
T = TypeVar("T")


class Client(Instructions):
    """One robot on a link, driven as a `Robot` is. `sees` says whether there is a probe to look.

    Nothing is sent until `home` or an instruction is called. Every method raises RobotError where
    the robot does not answer, sends an unsolicited answer, or cannot be reached any more.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        super().__init__(protocol, link)
        self.sees = sees

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to observe the robot; see --robot-probe")
        return self._do(observe()).look

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
        until = self._do(listen(None, 0)).now + patience
        while self.sees and self.look().moving:
            if self._do(listen(None, _SETTLE)).now >= until:
                raise RobotError("the robot still moves although it was sent a stop")

    def _do(self, procedure: Procedure[T]) -> T:
        try:
            return drive(procedure, self._link)
        except Ended as ended:
            raise RobotError(str(ended)) from ended
