"""A robot to talk to in a test: an instruction out, its answer back, a look through the probe.

It stands on a link (`conformance.drive.Link`), so a port in real time and a simulator in virtual
time are the same to a test.
"""

from __future__ import annotations

from dataclasses import dataclass

from captures.schemas import Look
from conformance.asks import Ask, Heard, Listen, See, Seen, Send
from conformance.drive import Link
from conformance.judging import MS
from conformance.run import Ended
from spec.codec import build, spaced
from spec.protocol import Protocol

_TRIES = 5  # an opened Arduino resets, and boots for some seconds
_SETTLE = 2 * MS


class RobotError(AssertionError):
    """The robot did not do what every robot must: answer, be silent, stop. One sentence."""


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer: its code, the code's name in the protocol (hex for an unused one), and how long
    (ms) after the last byte it came."""

    code: int
    name: str
    latency: float


class Client:
    """One robot on a link. `sees` tells whether a probe looks at it.

    Nothing is sent until `home` or `send` is called. Every method raises RobotError where the robot
    does not answer, answers unasked, or cannot be reached any more.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        self.protocol = protocol
        self.sees = sees
        self._link = link

    def send(self, name: str, /, **values: int) -> Answer:
        """Send an instruction by its name, with its fields' values, and wait for its answer.

        Raises ValueError for an instruction, a field or a value that the protocol does not have:
        to send what is wrong, see `send_bytes`.
        """
        (answer,) = self.send_bytes(build(self.protocol, name, values))
        return answer

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes as they are and wait for so many answers.

        An answer may take as long as the protocol lets it, a frame's time-out included.
        """
        stray = self._heard(Listen(None, 0))
        if stray.answers:
            raise RobotError(f"{self._words(stray)} came without an instruction")
        sent = self._do(Send(data))
        assert isinstance(sent, int)
        timing = self.protocol.timing
        patience = int((timing.answer_longest + timing.truncation_longest) * MS)
        heard = self._heard(Listen(answers, patience)) if answers else Heard((), sent)
        if len(heard.answers) != answers:
            came = self._words(heard) if heard.answers else "nothing"
            raise RobotError(
                f"{spaced(data)}: {answers} answers are due in {patience / MS:.0f} ms, but "
                f"{came} came"
            )
        return tuple(
            Answer(code, self._name(code), round((t - sent) / MS, 3)) for t, code in heard.answers
        )

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to look through; see --robot-probe")
        seen = self._do(See())
        assert isinstance(seen, Seen)
        return seen.look

    def wait(self, milliseconds: float) -> None:
        """Let time pass; what the robot sends meanwhile without being asked is a RobotError."""
        heard = self._heard(Listen(None, int(milliseconds * MS)))
        if heard.answers:
            raise RobotError(f"{self._words(heard)} came without an instruction")

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        Speed and LED stay as they were. The probe, if there is one, must see it stand still.
        """
        timing = self.protocol.timing
        count = self.protocol.longest_frame
        pause = int(max(timing.answer_deadline, timing.truncation_timeout) * MS)
        for _ in range(_TRIES):
            self._heard(Listen(None, 0))
            self._do(Send(bytes([self.protocol.filler]) * count))
            heard = self._heard(Listen(count, int(timing.answer_longest * MS)))
            if len(heard.answers) >= count:
                self._heard(Listen(None, _SETTLE))
                break
            # Some were taken as data that the robot was owed: after a pause it is owed none.
            late = self._heard(Listen(None, pause))
            if heard.answers or late.answers:
                break
        else:
            raise RobotError("nobody answers; is the robot on, and is it the right port?")
        self._require_still(int(timing.stop_longest * MS))

    def _require_still(self, patience: int) -> None:
        """Link and probe are two lines: a look may be a little older than the answer."""
        until = self._heard(Listen(None, 0)).now + patience
        while self.sees and self.look().moving:
            if self._heard(Listen(None, _SETTLE)).now >= until:
                raise RobotError("the robot still moves although it was told to stop")

    def _heard(self, ask: Listen) -> Heard:
        heard = self._do(ask)
        assert isinstance(heard, Heard)
        return heard

    def _do(self, ask: Ask) -> int | Heard | Seen:
        try:
            return self._link.do(ask)
        except Ended as ended:
            raise RobotError(str(ended)) from ended

    def _name(self, code: int) -> str:
        known = self.protocol.codes.get(code)
        return known.name if known else f"0x{code:02x}"

    def _words(self, heard: Heard) -> str:
        return " ".join(self._name(code) for code in heard.codes[:8])
