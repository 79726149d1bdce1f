"""Drives a robot on a link: one method per instruction of the protocol, each returns its answer."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock, get_ident
from typing import TYPE_CHECKING, Any, TypeVar

from bilprov.analyzer.client.operations import Heard, Link, Procedure, done, listen, send
from bilprov.analyzer.client.rest import nobody_words, rest_of
from bilprov.captures.schemas import MS
from bilprov.spec.codec import build, judge, spaced
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.python_names import method_names, parameter_names


class Turns:
    """A lock that its thread may take again, as a signal handler in it does.

    A thread that uses a robot without a pause would keep all others from a common lock, also the
    one that wants to stop it.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._next = RLock()  # held by the one thread that is next
        self._owner: int | None = None

    @contextmanager
    def taken(self, patience: float = -1) -> Iterator[bool]:
        """Take the lock until the block ends; gives whether it was got in `patience` s."""
        again = self._owner == get_ident()
        got = again or self._next.acquire(timeout=patience)
        if got:
            try:
                got = self._lock.acquire(timeout=patience)
            finally:
                if not again:
                    self._next.release()
        if not got:
            yield False
            return
        self._owner = get_ident()
        try:
            yield True
        finally:
            if not again:
                self._owner = None
            self._lock.release()


T = TypeVar("T")
_SHOWN = 8  # answers that a sentence lists


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


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer: its code, its name in the protocol (hex for an unused code), and its latency.

    `latency` is in ms from the last byte sent.
    """

    code: int
    name: str
    latency: float


class InstructionMethods(ABC):
    """What drives a device on a link: each instruction of `protocol` is a method.

    A subclass tells what a method does, and what it returns. `timeout` (ms) is how long an answer
    may take, None for the longest time that the protocol allows. Several threads may use one: each
    instruction and its answer are by themselves.
    """

    _port_name = ""

    def __init__(self, protocol: Protocol, link: Link, timeout: float | None = None) -> None:
        self.protocol = protocol
        self._link = link
        timing = protocol.timing
        longest = timing.answer_longest + timing.truncation_longest * protocol.plain
        self._patience = longest if timeout is None else timeout
        self._methods = method_names(protocol)
        self._in_step = True
        self._turns = Turns()
        self._rest = rest_of(protocol)

    def home(self) -> None:
        """Bring the device to rest from any state, and the line to the boundary of a frame.

        Settings that do not cause motion, such as speed and light, stay. Raises NoAnswer if the
        device does not answer what brings it to rest.
        """
        with self._alone():
            self._calm()
            if not self._do(self._rest.patiently()):
                raise self._nobody()
            self._in_step = True

    def _calm(self) -> None:  # noqa: B027  # stops need no silence before them
        """Wait until nothing comes that would be taken for an answer."""

    def wait(self, milliseconds: float) -> None:
        """Wait for the given time. Raises RobotError if the robot sends an unsolicited byte."""
        with self._alone():
            self._require_silence(round(milliseconds * MS))

    def __dir__(self) -> Iterable[str]:
        return sorted({*super().__dir__(), *self._methods})

    if not TYPE_CHECKING:
        # A type checker takes the methods from a stub, so it can report unknown names.
        def __getattr__(self, name: str) -> Any:
            return self._method(name)

    def _method(self, name: str) -> Any:
        if name.startswith("_"):  # copy and pickle ask for such names before `_methods` is set
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
        """The method of that name."""
        signature = self._signature(spec)

        def method(*given: Any, **named: Any) -> Any:
            try:
                values = signature.bind(*given, **named).arguments
            except TypeError as error:
                raise TypeError(f"{name}{signature}: {error}") from None
            return self._call(spec, values)

        method.__name__ = method.__qualname__ = name
        method.__doc__ = spec.prose or f"{spec.name} ({spec.document})."
        method.__signature__ = signature  # type: ignore[attr-defined]  # functions take any
        return method

    @abstractmethod
    def _signature(self, spec: InstructionSpec) -> inspect.Signature:
        """The signature of an instruction's method."""

    @abstractmethod
    def _call(self, spec: InstructionSpec, values: Mapping[str, Any]) -> Any:
        """Do what a method does that is called with these values of its parameters."""

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Keep other threads from the wire inside the block."""
        with self._turns.taken():
            yield

    def _do(self, procedure: Procedure[T]) -> T:
        """Run a procedure over the link. Raises LinkError."""
        return done(procedure, self._link)

    def _require_silence(self, patience: int) -> None:
        heard = self._do(listen(None, patience)).answers
        if heard:
            self._in_step = False
            raise RobotError(f"{self._names(heard)} came without an instruction")

    def _nobody(self) -> NoAnswer:
        words = nobody_words(self.protocol, self._port_name)
        return NoAnswer(words, b"".join(self._rest.frames()))

    def _refused(
        self, spec: InstructionSpec, frame: bytes, code: int, name: str, said: str
    ) -> Refused:
        """The error for an answer that refuses a frame; `said` is the answer in words."""
        known = self.protocol.codes.get(code)
        meaning = known.prose if known else f"{self.protocol.name} has no such response"
        what = f"{self._described(frame)} was answered {said}: {meaning}"
        return Refused(what, code, name, frame, spec.name)

    def _described(self, frame: bytes) -> str:
        """A valid frame in words, like `Speed speed=80 (11 50)`."""
        return f"{judge(self.protocol, frame).describe()} ({spaced(frame)})"

    def _names(self, heard: Heard) -> str:
        """The bytes that were heard in words, of which a sentence lists the first."""
        more = f" and {len(heard) - _SHOWN} more" if len(heard) > _SHOWN else ""
        return " ".join(self._name(code) for _, code in heard[:_SHOWN]) + more

    def _name(self, code: int) -> str:
        """A byte that was heard, in words."""
        return f"0x{code:02x}"


class Driver(InstructionMethods):
    """One robot on a link.

    Each instruction of `protocol` is a method: `RotateLeft` is `rotate_left()`, and its fields are
    the parameters, in order or by keyword. A method sends the instruction and returns its answer.

    A method raises ValueError, before anything is sent, for a value out of its range; Refused for
    any answer but the one to a valid instruction; NoAnswer if none comes in `timeout` ms (None: the
    longest time that the protocol allows, including the time-out of a frame that lost bytes);
    RobotError for a surplus or unsolicited answer; and LinkError when the line is lost. After any
    of the last three it is unknown which answer comes next, so the robot is homed, and thereby
    stopped, before the next instruction.

    Several threads may use one driver: each instruction and its answer are by themselves.
    """

    def send(self, name: str, /, **values: int) -> Answer:
        """Send an instruction by its name, with its fields' values, and wait for its answer.

        Any answer is returned, also a refusal. Raises ValueError for an instruction, a field or a
        value that the protocol does not have. Raises RobotError and LinkError as `send_bytes` does.
        """
        return self._exchange(build(self.protocol, name, values))

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes unchanged and wait for `answers` answers. Raises RobotError and LinkError.

        By default an answer may take the longest time that the protocol allows, including the
        time-out of a truncated frame.
        """
        with self._alone():
            self._in_step = False
            self._require_silence(0)
            sent = self._do(send(data))
            patience = round(self._patience * MS)
            heard = self._do(listen(answers, patience)).answers if answers else ()
            if len(heard) != answers:
                raise self._miscounted(data, answers, heard)
            self._in_step = True
        return tuple(Answer(code, self._name(code), round((t - sent) / MS, 3)) for t, code in heard)

    def _signature(self, spec: InstructionSpec) -> inspect.Signature:
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        return inspect.Signature(
            [inspect.Parameter(word, kind, annotation=int) for word in parameter_names(spec)],
            return_annotation=Answer,
        )

    def _call(self, spec: InstructionSpec, values: Mapping[str, Any]) -> Answer:
        parameters = parameter_names(spec)
        fields = {parameters[word].name: value for word, value in values.items()}
        frame = build(self.protocol, spec.name, fields)
        answer = self._exchange(frame)
        if answer.code != self.protocol.answers[Outcome.VALID].code:
            said = f"{answer.name} ({answer.code})"
            raise self._refused(spec, frame, answer.code, answer.name, said)
        return answer

    def _exchange(self, frame: bytes) -> Answer:
        with self._alone():
            if not self._in_step:
                self.home()
            (answer,) = self.send_bytes(frame)
        return answer

    def _miscounted(self, data: bytes, answers: int, heard: Heard) -> RobotError:
        due = "1 answer is" if answers == 1 else f"{answers} answers are"
        came = self._names(heard) if heard else "nothing"
        sentence = f"{self._described(data)}: {due} due in {self._patience:g} ms, but {came} came"
        return RobotError(sentence) if heard else NoAnswer(sentence, data)

    def _described(self, data: bytes) -> str:
        """The bytes in words; in hex only if they are no valid frame."""
        whole = data and len(data) == 1 + self.protocol.lengths[data[0]]
        valid = whole and judge(self.protocol, data).valid
        return super()._described(data) if valid else spaced(data)

    def _name(self, code: int) -> str:
        known = self.protocol.codes.get(code)
        return known.name if known else f"0x{code:02x}"
