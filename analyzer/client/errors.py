"""Exceptions for the faults of a robot that is driven from Python; each message is one sentence."""

from __future__ import annotations


class RobotError(Exception):
    """The robot broke a rule: answer each instruction once, send nothing unsolicited, and stop."""

    def __str__(self) -> str:
        """The sentence without the other arguments, which are attributes."""
        return str(self.args[0]) if self.args else ""


class NoAnswer(RobotError):
    """No answer came in time; `frame` holds the bytes that were sent."""

    def __init__(self, sentence: str, frame: bytes) -> None:
        super().__init__(sentence, frame)
        self.frame = frame


class Refused(RobotError):
    """The robot answered that an instruction was faulty; it has stopped by itself (section 2).

    `code` is the response code, `answer` its name in the protocol (hex for an unused code),
    `frame` the bytes that were sent, and `instruction` the name of the instruction.
    """

    def __init__(
        self, sentence: str, code: int, answer: str, frame: bytes, instruction: str
    ) -> None:
        super().__init__(sentence, code, answer, frame, instruction)
        self.code = code
        self.answer = answer
        self.frame = frame
        self.instruction = instruction
