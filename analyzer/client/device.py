"""Drives a device of any grammar from Python: methods return the fields of the answers."""

from __future__ import annotations

import inspect
import os
from collections import namedtuple
from collections.abc import Mapping
from functools import lru_cache
from os import PathLike
from typing import Any

from bilprov.analyzer.client.driver import InstructionMethods, NoAnswer, RobotError
from bilprov.analyzer.client.operations import listen
from bilprov.analyzer.client.port_driver import OnPort
from bilprov.analyzer.client.rest import exchange
from bilprov.analyzer.grammar_file import given_protocol
from bilprov.analyzer.transport.errors import first_bytes
from bilprov.analyzer.transport.machine import Machine
from bilprov.captures.schemas import MS
from bilprov.spec.by_effect import change_by
from bilprov.spec.codec import Judgement, build, judge, spaced
from bilprov.spec.data import DataSpec
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Part
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.python_names import answer_names, parameter_names, read_by_name, taken_type
from bilprov.spec.replies import Reply, read_reply, reply_size

_TRIES = 20  # time-outs that a line is waited for to fall silent


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

    _address: int | None = None
    _only_reading = False
    _least_pause = 0  # ns that may pass between two bytes of an answer, whatever the grammar allows

    def __getattr__(self, name: str) -> Any:  # of any grammar, so a type checker knows no names
        return self._method(name)

    def send(self, name: str, /, **values: Any) -> Reply | None:
        """Send an instruction by its name, with its fields' values, and return its answer.

        Any answer is returned, also an error; None where none is due. Raises as the methods do,
        except Refused.
        """
        return self._exchange(build(self.protocol, name, self._addressed(values)))

    def _signature(self, spec: InstructionSpec) -> inspect.Signature:
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
        register, count = read_by_name(self.protocol, spec)
        special = {
            register: inspect.Parameter("_", kind, annotation="int | str"),
            count: inspect.Parameter("_", kind, default=None, annotation="int | None"),
        }
        parameters = [
            special.get(
                part.name, inspect.Parameter("_", kind, annotation=taken_type(part))
            ).replace(name=word)
            for word, part in parameter_names(spec).items()
        ]
        part = _address_part(self.protocol)
        if part is not None:
            only = inspect.Parameter.KEYWORD_ONLY
            parameters.append(
                inspect.Parameter(part.name, only, default=None, annotation="int | None")
            )
        return inspect.Signature(parameters)

    def _call(self, spec: InstructionSpec, values: Mapping[str, Any]) -> Any:
        names = {word: part.name for word, part in parameter_names(spec).items()}
        fields = {names.get(word, word): value for word, value in values.items()}
        frame = build(self.protocol, spec.name, self._addressed(fields))
        reply = self._exchange(frame)
        if reply is None:
            return None
        if Outcome.VALID not in reply.outcomes:
            name = " ".join(reply.names) or spaced(reply.frame)
            code = reply.response.code if reply.response else reply.frame[-1]
            raise self._refused(spec, frame, code, name, name)
        register = fields.get(read_by_name(self.protocol, spec)[0])
        for one, value in reply.registers:
            if one.name == register:
                return one.named(value)
        return _told(spec.answer, dict(reply.fields))

    def _addressed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values with the address that is meant."""
        part = _address_part(self.protocol)
        given = {name: value for name, value in values.items() if value is not None}
        if part is None:
            return given
        if part.name in given:
            require_address(self.protocol, given[part.name])
        elif self._address is not None:
            given[part.name] = self._address
        return given

    def _exchange(self, frame: bytes) -> Reply | None:
        asked = judge(self.protocol, frame)
        change = change_by(self.protocol, frame) if self._only_reading else ""
        if change:
            raise ValueError(f"{change}: only_reading sends what changes nothing")
        with self._alone():
            if not self._in_step:
                self.home()
            self._in_step = False
            self._require_silence(self._pause)
            self._rest.note(asked.address)
            pause = max(self._least_pause, round(self.protocol.timing.truncation_timeout * MS))
            patience = round(self._patience * MS)
            heard = self._do(exchange(self.protocol, asked, patience, pause))
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


class Device(DeviceDriver, OnPort):
    """A device on a port, driven from Python; each instruction of the grammar is a method.

        with Device("/dev/ttyUSB0", grammar="modbus-rtu", address=17) as meter:
            first, second = meter.read_holding_registers(start=0, quantity=2)

    `grammar` is the name of a shipped grammar, a file or a Protocol. `address` is the device that
    is meant unless a method is called with another one. With `only_reading` a method that may
    change something raises ValueError instead of sending it. `OnPort` describes the other
    arguments and how it is left, `DeviceDriver` the methods and the exceptions. Nothing is sent at
    first and at the end, unless the grammar tells when the device is at rest.
    """

    def __init__(
        self,
        url: str | PathLike[str],
        *,
        grammar: str | PathLike[str] | Protocol | None = None,
        address: int | None = None,
        only_reading: bool = False,
        timeout: float | None = None,
        baud: int | None = None,
        parity: str | None = None,
        stopbits: float | None = None,
        echo: bool = False,
    ) -> None:
        grammar = given_protocol(grammar)
        if address is not None:
            require_address(grammar, address)
        self._address = address
        self._only_reading = only_reading
        self._least_pause = Machine().least_pause(os.fspath(url))
        super().__init__(
            url,
            grammar=grammar,
            timeout=timeout,
            baud=baud,
            parity=parity,
            stopbits=stopbits,
            echo=echo,
        )


def require_address(protocol: Protocol, address: object) -> None:
    """Raise ValueError unless a frame can be sent to that address."""
    part = _address_part(protocol)
    if part is None:
        raise ValueError(f"{protocol.name} has no addresses; address is {address!r}")
    if not part.reaches(address):
        raise ValueError(f"{part.name} is {address!r}, allowed are {part.allowed}")


def _address_part(protocol: Protocol) -> Part | None:
    return protocol.layout.part("address")


@lru_cache(maxsize=1024)
def _answer_class(names: tuple[str, ...]) -> Any:
    return namedtuple("Answer", names)


def _told(data: DataSpec | None, fields: Mapping[str, Any]) -> Any:
    """What an answer holds: nothing, its one value, or a named tuple of several."""
    if not fields or data is None:
        return None
    names = answer_names(data)
    values = [part.named(fields[part.name]) for part in names.values()]
    return values[0] if len(values) == 1 else _answer_class(tuple(names))(*values)
