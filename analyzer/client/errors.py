"""What a robot can do wrong to whoever drives it, as exceptions; each is one sentence."""

from __future__ import annotations


class RobotError(Exception):
    """The robot did not do what every robot must: answer once, be silent unasked, stop."""

    def __str__(self) -> str:
        """The sentence alone; the other arguments are attributes."""
        return str(self.args[0]) if self.args else ""


class NoAnswer(RobotError):
    """No answer came in time to `frame`, which is what was sent."""

    def __init__(self, sentence: str, frame: bytes) -> None:
        super().__init__(sentence, frame)
        self.frame = frame


class Refused(RobotError):
    """The robot answered that an instruction was faulty; it has stopped by itself (section 2).

    `code` is the response code and `answer` its name in the protocol (hex for an unused one),
    `frame` what was sent, `instruction` its name.
    """

    def __init__(
        self, sentence: str, code: int, answer: str, frame: bytes, instruction: str
    ) -> None:
        super().__init__(sentence, code, answer, frame, instruction)
        self.code = code
        self.answer = answer
        self.frame = frame
        self.instruction = instruction
