"""Drives a device on a link: one method per instruction of its grammar, which gives the answer."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections import namedtuple
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from threading import RLock, get_ident
from typing import TYPE_CHECKING, Any, TypeVar

from bilprov.analyzer.client.operations import Heard, Link, Procedure, done, listen, send
from bilprov.analyzer.client.rest import Rest, exchange, nobody_words
from bilprov.analyzer.transport.errors import first_bytes
from bilprov.captures.schemas import MS
from bilprov.spec.by_effect import change_by
from bilprov.spec.codec import Judgement, build, judge, spaced
from bilprov.spec.emit import python as methods
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.replies import Reply, read_reply, reply_size


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
        if got and not again:
            try:
                got = self._lock.acquire(timeout=patience)
            finally:
                self._next.release()
        if got:
            self._owner = get_ident()
        try:
            yield got
        finally:
            if got and not again:
                self._owner = None
                self._lock.release()


T = TypeVar("T")
_SHOWN = 8  # answers that a sentence lists
_TRIES = 20  # time-outs that a line is waited for to fall silent


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

    Its fields are the parameters, in order or by keyword. A subclass sends the frame, and gives
    what the method returns. `timeout` (ms) is how long an answer may take, None for the longest
    time that the protocol allows. Several threads may use one: each instruction and its answer are
    by themselves.
    """

    _port_name = ""
    _address: int | None = None  # of the device that is meant unless another is named
    _only_reading = False
    _least_pause = 0  # ns that may pass between two bytes of an answer, whatever the grammar allows
    _returned: Any = inspect.Signature.empty

    def __init__(self, protocol: Protocol, link: Link, timeout: float | None = None) -> None:
        self.protocol = protocol
        self._link = link
        timing = protocol.timing
        longest = timing.answer_longest + timing.truncation_longest * protocol.plain
        self._patience = longest if timeout is None else timeout
        self._methods = methods.method_names(protocol)
        self._in_step = True
        self._turns = Turns()
        self._rest = Rest(protocol)

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
        """The method of that name. Raises AttributeError."""
        if name.startswith("_"):  # copy and pickle ask for such names before `_methods` is set
            raise AttributeError(f"{type(self).__name__} has no {name!r}")
        spec = self._methods.get(name)
        if spec is None:
            why = f"{self.protocol.name} has no instruction {name!r}; there are "
            raise AttributeError(why + ", ".join(self._methods), name=name, obj=self)
        signature, fields = self._signature(spec), methods.parameter_names(spec)

        def method(*given: Any, **named: Any) -> Any:
            try:
                values = signature.bind(*given, **named).arguments
            except TypeError as error:
                raise TypeError(f"{name}{signature}: {error}") from None
            known = {getattr(fields.get(word), "name", word): values[word] for word in values}
            frame = self._built(spec.name, known)
            return self._result(spec, frame, known, self._exchange(frame))

        method.__name__ = method.__qualname__ = name
        method.__doc__ = spec.prose or f"{spec.name} ({spec.document})."
        method.__signature__ = signature  # type: ignore[attr-defined]  # functions take any
        return method

    def _signature(self, spec: InstructionSpec) -> inspect.Signature:
        """The signature of an instruction's method."""
        kind, only = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY
        register, count = methods.read_by_name(self.protocol, spec)
        parameters = []
        for word, part in methods.parameter_names(spec).items():
            taken: Any = "int | str" if part.name == register else methods.taken_type(part)
            parameter = inspect.Parameter(word, kind, annotation=int if taken == "int" else taken)
            if part.name == count:
                parameter = parameter.replace(default=None, annotation="int | None")
            parameters.append(parameter)
        address = self.protocol.layout.part("address")
        if address is not None:
            parameters.append(
                inspect.Parameter(address.name, only, default=None, annotation="int | None")
            )
        return inspect.Signature(parameters, return_annotation=self._returned)

    def _built(self, name: str, values: Mapping[str, Any]) -> bytes:
        """The frame of an instruction to the device that is meant. Raises ValueError."""
        part = self.protocol.layout.part("address")
        given = {name: value for name, value in values.items() if value is not None}
        if part is not None and part.name in given:
            require_address(self.protocol, given[part.name])
        elif part is not None and self._address is not None:
            given[part.name] = self._address
        frame = build(self.protocol, name, given)
        change = change_by(self.protocol, frame) if self._only_reading else ""
        if change:
            raise ValueError(f"{change}: only_reading sends what changes nothing")
        return frame

    @abstractmethod
    def _exchange(self, frame: bytes) -> Any:
        """Send a frame of an instruction, and return its answer."""

    @abstractmethod
    def _result(
        self, spec: InstructionSpec, frame: bytes, fields: Mapping[str, Any], answer: Any
    ) -> Any:
        """What the method returns for an answer. Raises Refused."""

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

    _returned = Answer

    def send(self, name: str, /, **values: int) -> Answer:
        """Send an instruction by its name, with its fields' values, and wait for its answer.

        Any answer is returned, also a refusal. Raises ValueError for an instruction, a field or a
        value that the protocol does not have. Raises RobotError and LinkError as `send_bytes` does.
        """
        return self._exchange(self._built(name, values))

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes unchanged and wait for `answers` answers. Raises RobotError and LinkError.

        By default an answer may take the longest time that the protocol allows, including the
        time-out of a truncated frame.
        """
        if self._only_reading and (not self._valid(data) or change_by(self.protocol, data)):
            raise ValueError(f"{spaced(data)}: only_reading sends what changes nothing")
        with self._alone():
            self._in_step = False
            self._require_silence(0)
            sent = self._do(send(data))
            patience = round(self._patience * MS)
            heard = self._do(listen(answers, patience)).answers if answers else ()
            if len(heard) != answers:
                due = "1 answer is" if answers == 1 else f"{answers} answers are"
                came = self._names(heard) if heard else "nothing"
                what = f"{self._described(data)}: {due} due in {self._patience:g} ms"
                sentence = f"{what}, but {came} came"
                raise RobotError(sentence) if heard else NoAnswer(sentence, data)
            self._in_step = True
        return tuple(Answer(code, self._name(code), round((t - sent) / MS, 3)) for t, code in heard)

    def _result(
        self, spec: InstructionSpec, frame: bytes, fields: Mapping[str, Any], answer: Answer
    ) -> Answer:
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

    def _described(self, data: bytes) -> str:
        """The bytes in words; in hex only if they are no valid frame."""
        return super()._described(data) if self._valid(data) else spaced(data)

    def _valid(self, data: bytes) -> bool:
        whole = bool(data) and len(data) == 1 + self.protocol.lengths[data[0]]
        return whole and judge(self.protocol, data).valid

    def _name(self, code: int) -> str:
        known = self.protocol.codes.get(code)
        return known.name if known else f"0x{code:02x}"


class DeviceDriver(InstructionMethods):
    """The devices on a link, of which `address` is the one that is meant unless another is named.

    Each instruction of `protocol` is a method: `ReadCoils` is `read_coils()`, and its fields are
    the parameters, in order or by keyword; where frames have an address, `address=` names another
    device. A method sends the instruction and returns what the answer holds: its one value, a named
    tuple of several, or None; None also where no answer is due, as after what is sent to all. A
    value that has a name is returned as its name. A register that is read by its name is returned
    as its value, not as bytes.

    A method raises ValueError, before anything is sent, for a value out of its range; Refused for
    an answer that is an error; NoAnswer if none comes in `timeout` ms (None: the longest time that
    the protocol allows); RobotError for a damaged answer, and for bytes that answer nothing; and
    LinkError when the line is lost. After any of the last three the line has to fall silent before
    the next instruction is sent.
    """

    def __getattr__(self, name: str) -> Any:  # of any grammar, so a type checker knows no names
        return self._method(name)

    def send(self, name: str, /, **values: Any) -> Reply | None:
        """Send an instruction by its name, with its fields' values, and return its answer.

        Any answer is returned, also an error; None where none is due. Raises as the methods do,
        except Refused.
        """
        return self._exchange(self._built(name, values))

    def _result(
        self, spec: InstructionSpec, frame: bytes, fields: Mapping[str, Any], answer: Reply | None
    ) -> Any:
        if answer is None:
            return None
        if Outcome.VALID not in answer.outcomes:
            name = " ".join(answer.names) or spaced(answer.frame)
            code = answer.response.code if answer.response else answer.frame[-1]
            raise self._refused(spec, frame, code, name, name)
        register = fields.get(methods.read_by_name(self.protocol, spec)[0])
        for one, value in answer.registers:
            if one.name == register:
                return one.named(value)
        if not answer.fields or spec.answer is None:
            return None
        told = dict(answer.fields)
        names = methods.answer_names(spec.answer)
        values = [part.named(told[part.name]) for part in names.values()]
        return values[0] if len(values) == 1 else _answer_class(tuple(names))(*values)

    def _exchange(self, frame: bytes) -> Reply | None:
        asked = judge(self.protocol, frame)
        with self._alone():
            if not self._in_step:
                self.home()
            self._in_step = False
            self._require_silence(self._pause)
            self._rest.note(asked.address)
            pause = max(self._least_pause, round(self.protocol.timing.truncation_timeout * MS))
            heard = self._do(exchange(self.protocol, asked, round(self._patience * MS), pause))
            if not asked.answer_due:
                self._in_step = True
                return None
            reply = self._read(asked, heard)
            self._in_step = True
            return reply

    @property
    def _pause(self) -> int:
        """The silence (ns) before a frame, where nothing else tells that it begins."""
        layout = self.protocol.layout
        if self.protocol.plain or layout.part("length") or layout.constants:
            return 0
        return round(self.protocol.timing.truncation_shortest * MS)

    def _read(self, asked: Judgement, heard: bytes) -> Reply:
        """The answer in what was heard. Raises NoAnswer and RobotError if it is none."""
        what = self._described(asked.frame)
        if not heard:
            raise NoAnswer(f"{what} was not answered in {self._patience:g} ms", asked.frame)
        size = reply_size(self.protocol, heard, asked)
        if size is None or size > len(heard):
            due = f" of {size}" if size else ""
            raise RobotError(f"{what}: the answer broke off after {len(heard)}{due} bytes")
        reply = read_reply(self.protocol, heard[:size] if size > 0 else heard, asked)
        surplus = heard[size:] if size > 0 else b""
        # The echo of a request may be laid out as an answer, whose code then is one by chance.
        came_back = heard == asked.frame and len(heard) > 1
        alike = came_back and Outcome.VALID not in reply.outcomes
        if not (reply.reason or surplus or alike):
            return reply
        if asked.frame.startswith(heard[: len(asked.frame)]):
            raise RobotError(f"{what} came back: where the line has an echo, use echo=True")
        if reply.reason:
            raise RobotError(f"{what} was answered {first_bytes(heard)}: {reply.reason}")
        raise RobotError(f"{what}: {first_bytes(surplus)} came after its answer")

    def _calm(self) -> None:
        """Wait until nothing is heard for as long as a frame may pause. Raises RobotError."""
        self._rest.note(self._address)
        if self._in_step and not self._do(listen(None, 0)).answers:
            return
        pause = round(self.protocol.timing.truncation_timeout * MS)
        for _ in range(_TRIES):
            if not self._do(listen(None, pause)).answers:
                return
        raise RobotError("the line does not fall silent: something else sends on it")


@lru_cache(maxsize=1024)
def _answer_class(names: tuple[str, ...]) -> Any:
    return namedtuple("Answer", names)


def require_address(protocol: Protocol, address: object) -> None:
    """Raise ValueError unless a frame can be sent to that address."""
    part = protocol.layout.part("address")
    if part is None:
        raise ValueError(f"{protocol.name} has no addresses; address is {address!r}")
    if not part.reaches(address):
        raise ValueError(f"{part.name} is {address!r}, allowed are {part.allowed}")
