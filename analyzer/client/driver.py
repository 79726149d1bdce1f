"""A robot on a wire: an instruction out, its one answer back; the methods are the Protocol's."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analyzer.client.errors import NoAnswer, Refused, RobotError
from analyzer.client.homing import home, stops
from analyzer.decode.pairing import MILLISECOND
from analyzer.transport.wire import Heard, Wire
from spec.codec import build, judge, spaced
from spec.fields import Outcome
from spec.protocol import InstructionSpec, Protocol
from spec.python_names import method_names, parameter_names

_SHOWN = 8  # answers that a sentence lists


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer: its code, the code's name in the protocol (hex for an unused one), and how long
    (ms) after the last byte it came."""

    code: int
    name: str
    latency: float


class Driver:
    """One robot on a wire.

    Each instruction of `protocol` is a method: `RotateLeft` is `rotate_left()`, and its fields are
    the parameters, in order or by keyword. A method waits for the one answer. It raises ValueError,
    before anything is sent, for a value out of its range; Refused for any answer but the one to a
    valid instruction; NoAnswer where none comes in `timeout` ms (None: the longest that the
    protocol allows, for a frame of which bytes were lost on the way too); RobotError for an answer
    too many or unasked; and LinkError when the line is lost. After any of these but Refused nobody
    knows which answer comes next: the robot is homed, so it stops, before the next instruction.
    """

    def __init__(self, protocol: Protocol, wire: Wire, timeout: float | None = None) -> None:
        timing = protocol.timing
        longest = timing.answer_longest + timing.truncation_longest
        self.protocol = protocol
        self._wire = wire
        self._patience = longest if timeout is None else timeout
        self._methods = method_names(protocol)
        self._in_step = True

    def send(self, name: str, /, **values: int) -> Answer:
        """Send an instruction by its name, with its fields' values, and wait for its answer.

        Whatever the answer is, it is returned. Raises ValueError for an instruction, a field or a
        value that the protocol does not have: to send what is wrong, see `send_bytes`.
        """
        return self._exchange(build(self.protocol, name, values))

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes as they are and wait for so many answers. Raises RobotError and LinkError.

        An answer may take as long as the protocol lets it, a frame's time-out included.
        """
        self._in_step = False
        self._require_silence(0)
        sent = self._wire.send(data)
        heard = self._wire.listen(answers, round(self._patience * MILLISECOND)) if answers else ()
        if len(heard) != answers:
            raise self._miscounted(data, answers, heard)
        self._in_step = True
        return tuple(
            Answer(code, self._name(code), round((t - sent) / MILLISECOND, 3)) for t, code in heard
        )

    def wait(self, milliseconds: float) -> None:
        """Let time pass; what the robot sends meanwhile without being asked is a RobotError."""
        self._require_silence(round(milliseconds * MILLISECOND))

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        What instructions without a motion set, such as speed and light, stays. Raises NoAnswer
        where nobody answers.
        """
        if not home(self.protocol, self._wire):
            raise self._nobody()
        self._in_step = True

    def __dir__(self) -> Iterable[str]:
        return sorted({*super().__dir__(), *self._methods})

    if not TYPE_CHECKING:
        # A type checker takes the methods from robot.pyi, and tells a name that is none.
        def __getattr__(self, name: str) -> Any:
            return self._method(name)

    def _method(self, name: str) -> Any:
        if name.startswith("_"):  # whoever copies or pickles asks before there are any methods
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        spec = self._methods.get(name)
        if spec is None:
            raise AttributeError(
                f"{self.protocol.name} has no instruction {name!r}; there are "
                f"{', '.join(self._methods)}",
                name=name,
                obj=self,
            )
        return self._made(name, spec)

    def _made(self, name: str, spec: InstructionSpec) -> Any:
        parameters = parameter_names(spec)
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        signature = inspect.Signature(
            [inspect.Parameter(word, kind, annotation=int) for word in parameters],
            return_annotation=Answer,
        )

        def method(*given: int, **named: int) -> Answer:
            try:
                values = signature.bind(*given, **named).arguments
            except TypeError as error:
                raise TypeError(f"{name}{signature}: {error}") from None
            fields = {parameters[word].name: value for word, value in values.items()}
            frame = build(self.protocol, spec.name, fields)
            answer = self._exchange(frame)
            if answer.code != self.protocol.answers[Outcome.VALID].code:
                raise self._refused(spec, frame, answer)
            return answer

        method.__name__ = method.__qualname__ = name
        method.__doc__ = spec.prose
        method.__signature__ = signature  # type: ignore[attr-defined]  # functions take any
        return method

    def _exchange(self, frame: bytes) -> Answer:
        if not self._in_step:
            self.home()
        (answer,) = self.send_bytes(frame)
        return answer

    def _require_silence(self, patience: int) -> None:
        heard = self._wire.listen(None, patience)
        if heard:
            self._in_step = False
            raise RobotError(f"{self._names(heard)} came without an instruction")

    def _refused(self, spec: InstructionSpec, frame: bytes, answer: Answer) -> Refused:
        known = self.protocol.codes.get(answer.code)
        meaning = known.prose if known else f"{self.protocol.name} has no such response"
        return Refused(
            f"{self._described(frame)} was answered {answer.name} ({answer.code}): {meaning}",
            answer.code,
            answer.name,
            frame,
            spec.name,
        )

    def _miscounted(self, data: bytes, answers: int, heard: Heard) -> RobotError:
        due = "1 answer is" if answers == 1 else f"{answers} answers are"
        came = self._names(heard) if heard else "nothing"
        sentence = f"{self._described(data)}: {due} due in {self._patience:g} ms, but {came} came"
        return RobotError(sentence) if heard else NoAnswer(sentence, data)

    def _nobody(self) -> NoAnswer:
        return NoAnswer(
            "nobody answers; is the robot on, and is it the right port?", stops(self.protocol)
        )

    def _described(self, data: bytes) -> str:
        """`Speed speed=80 (11 50)`; bytes that are no valid frame as they are."""
        if data and len(data) == 1 + self.protocol.lengths[data[0]]:
            judgement = judge(self.protocol, data)
            if judgement.valid:
                return f"{judgement.describe()} ({spaced(data)})"
        return spaced(data)

    def _names(self, heard: Heard) -> str:
        more = f" and {len(heard) - _SHOWN} more" if len(heard) > _SHOWN else ""
        return " ".join(self._name(code) for _, code in heard[:_SHOWN]) + more

    def _name(self, code: int) -> str:
        known = self.protocol.codes.get(code)
        return known.name if known else f"0x{code:02x}"
