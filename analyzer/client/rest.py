"""Brings a device to rest: a car by stops, another one by the requests that its grammar has."""

from __future__ import annotations

from typing import Any, Protocol

from bilprov.analyzer.client.exchange import exchange
from bilprov.analyzer.client.homing import home_once, stops
from bilprov.analyzer.client.operations import Procedure, listen
from bilprov.captures.schemas import MS
from bilprov.spec import protocol as spec_protocol
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import InstructionSpec
from bilprov.spec.state import AnyOf, FromField, State


class Rest(Protocol):
    """How a device is brought to rest."""

    def note(self, address: int | None) -> None:
        """Take note of a device that was spoken to, and may have to be brought to rest."""

    def frames(self) -> tuple[bytes, ...]:
        """What is sent for that, one frame after the other."""

    def after(self, state: State) -> State:
        """The state of a device after that."""

    def once(self) -> Procedure[bool]:
        """Bring it to rest once; returns whether all that was sent was answered."""


class Stops:
    """Brings a robot of the car's family to rest by stops, also in the middle of a frame."""

    def __init__(self, protocol: spec_protocol.Protocol) -> None:
        self._protocol = protocol

    def note(self, address: int | None) -> None:
        """As in Rest; there are no addresses."""

    def frames(self) -> tuple[bytes, ...]:
        """As in Rest."""
        return (stops(self._protocol),)

    def after(self, state: State) -> State:
        """As in Rest."""
        return self._protocol.stop.effect.apply(state)

    def once(self) -> Procedure[bool]:
        """As in Rest."""
        return home_once(self._protocol)


class Requests:
    """Brings each device that was spoken to to rest; does nothing where no request does that."""

    def __init__(self, protocol: spec_protocol.Protocol) -> None:
        self._protocol = protocol
        self._part = protocol.layout.part("address")
        self._requests = rest_requests(protocol)
        self._addresses: set[int] = set()

    def note(self, address: int | None) -> None:
        """As in Rest."""
        if address is not None:
            self._addresses.add(address)

    def frames(self) -> tuple[bytes, ...]:
        """As in Rest."""
        addresses: list[dict[str, int]] = [{}]
        if self._part is not None:
            addresses = [{self._part.name: address} for address in sorted(self._addresses)]
        return tuple(
            build(self._protocol, name, {**fields, **address})
            for address in addresses
            for name, fields in self._requests
        )

    def after(self, state: State) -> State:
        """As in Rest."""
        for name, fields in self._requests:
            state = self._protocol.by_name[name].effect.apply(state, fields)
        return state

    def once(self) -> Procedure[bool]:
        """As in Rest."""
        timing = self._protocol.timing
        yield from listen(None, 0)
        answered = True
        for frame in self.frames():
            asked = judge(self._protocol, frame)
            heard = yield from exchange(
                self._protocol,
                asked,
                round(timing.answer_longest * MS),
                round(timing.truncation_timeout * MS),
            )
            answered = answered and (bool(heard) or not asked.answer_due)
        return answered


def rest_of(protocol: spec_protocol.Protocol) -> Rest:
    """How a device of this protocol is brought to rest."""
    return Stops(protocol) if protocol.plain and protocol.stop_or_none else Requests(protocol)


def rest_requests(protocol: spec_protocol.Protocol) -> tuple[tuple[str, dict[str, Any]], ...]:
    """The requests, each a name and fields, that bring a device to rest whatever it did before.

    None where the grammar does not tell when the device is at rest, or no requests reach that.
    """
    if protocol.at_rest is None:
        return ()
    if protocol.stop_or_none is not None:
        return ((protocol.stop_or_none.name, {}),)
    found = []
    for variable, value in protocol.at_rest.values.items():
        request = _setting(protocol, variable, value)
        if request is not None and isinstance(protocol.at_rest, AnyOf):
            return (request,)
        found.append(request)
    reached = tuple(request for request in found if request is not None)
    return reached if len(reached) == len(found) else ()


def _setting(
    protocol: spec_protocol.Protocol, variable: str, value: str | int
) -> tuple[str, dict[str, Any]] | None:
    """A request that gives a variable a value, and sets no other; None if there is none."""
    for spec in protocol.instructions:
        if {name for name, _ in spec.effect.assignments} == {variable}:
            fields = _fields_for(spec, dict(spec.effect.assignments)[variable], value)
            if fields is not None:
                return spec.name, fields
    return None


def _fields_for(spec: InstructionSpec, source: Any, value: str | int) -> dict[str, Any] | None:
    """The fields with which what an effect sets has this value; None if it cannot have it."""
    fields: dict[str, Any] = {part.name: part.low for part in spec.fields if not part.many}
    if len(fields) < len(spec.fields):
        return None
    if not isinstance(source, FromField):
        return fields if source == value else None
    number = source.number(value)
    part = next(part for part in spec.fields if part.name == source.field)
    if number is None or not part.in_range(number):
        return None
    return {**fields, part.name: number}
