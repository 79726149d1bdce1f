"""Brings a device to rest: a car by stops, another one by the requests that its grammar has."""

from __future__ import annotations

from typing import Protocol

from bilprov.analyzer.client.exchange import exchange
from bilprov.analyzer.client.homing import home_once, stops
from bilprov.analyzer.client.operations import Ended, Procedure, listen
from bilprov.captures.schemas import MS
from bilprov.spec import protocol as spec_protocol
from bilprov.spec.codec import build, judge
from bilprov.spec.state import State


class Rest(Protocol):
    """How a device is brought to rest."""

    def note(self, address: int | None) -> None:
        """Take note of a device that was spoken to, and may have to be brought to rest."""

    def frames(self) -> tuple[bytes, ...]:
        """What is sent for that, one frame after the other."""

    def after(self, state: State) -> State:
        """The state of a device after that."""

    def once(self) -> Procedure[bool]:
        """Bring it to rest once; returns whether it was answered.

        At an address at which nobody has answered yet, nobody needs to, as long as others do.
        """


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
        self._requests = protocol.rest_requests
        self._addresses: set[int] = set()
        self._heard: set[int | None] = set()

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
        pause = round(timing.truncation_timeout * MS)
        frames = self.frames()
        yield from listen(None, pause if frames else 0)  # an answer under way is none to these
        due: set[int | None] = set()
        silent: set[int | None] = set()
        failed: Ended | None = None
        for frame in frames:
            asked = judge(self._protocol, frame)
            patience = round(timing.answer_longest * MS)
            try:
                heard = yield from exchange(self._protocol, asked, patience, pause)
            except Ended as error:  # the others are sent all the same
                failed = error
                continue
            if asked.answer_due:
                due.add(asked.address)
                (self._heard if heard else silent).add(asked.address)
        if failed:
            raise failed
        return silent.isdisjoint(self._heard) and (not due or silent != due)


def rest_of(protocol: spec_protocol.Protocol) -> Rest:
    """How a device of this protocol is brought to rest."""
    return Stops(protocol) if protocol.plain and protocol.stop_or_none else Requests(protocol)
