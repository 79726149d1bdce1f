"""The state of each device on a bus, as the requests to its address predict it."""

from __future__ import annotations

from collections.abc import Iterable

from bilprov.spec.protocol import Protocol
from bilprov.spec.state import OTHERS, Assigned, State, after


class BusState:
    """The states by address; that of a device which was not addressed is that of OTHERS."""

    def __init__(self, protocol: Protocol) -> None:
        self._part = protocol.layout.part("address")
        self._states: dict[int, State] = {OTHERS: protocol.power_on}

    def after(self, address: int, sets: Assigned) -> State:
        """The state of the addressed device after a frame that sets some variables.

        What is sent to all changes all.
        """
        if self._part is not None and address == self._part.broadcast:
            self._states = {one: after(state, sets) for one, state in self._states.items()}
            return self._states[OTHERS]
        state = self._states.get(address, self._states[OTHERS])
        if self._for_one(address):
            state = self._states[address] = after(state, sets)
        return state

    @property
    def saved(self) -> tuple[tuple[int, State], ...]:
        """Each address and its state."""
        return tuple(sorted(self._states.items()))

    def resume(self, states: Iterable[tuple[int, State]]) -> None:
        """Go on from saved states; none is the state of power-on for all."""
        self._states = {OTHERS: self._states[OTHERS], **dict(states)}

    def _for_one(self, address: int) -> bool:
        """Whether a device can have that address, so that there is no end of them."""
        part = self._part
        return part is not None and part.low <= address <= part.high
