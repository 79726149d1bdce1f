"""The state of each device on a bus, as the requests to its address predict it."""

from __future__ import annotations

from collections.abc import Iterable

from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State, after
from bilprov.spec.steps import Step

OTHERS = -1
"""Stands for the address of every device that was not addressed yet."""


class BusState:
    """The states by address; that of a device which was not addressed is that of OTHERS."""

    def __init__(self, protocol: Protocol) -> None:
        self._part = protocol.layout.part("address")
        self._states: dict[int, State] = {OTHERS: protocol.power_on}

    def after(self, step: Step) -> State:
        """The state of the addressed device after a frame; what is sent to all changes all."""
        judgement = step.judgement
        address = judgement.address if judgement.address is not None else OTHERS
        if self._for_all(judgement):
            self._states = {one: after(state, step.sets) for one, state in self._states.items()}
            return self._states[OTHERS]
        state = self._states.get(address, self._states[OTHERS])
        if self._for_one(address):
            state = self._states[address] = after(state, step.sets)
        return state

    @property
    def saved(self) -> tuple[tuple[int, State], ...]:
        """Each address and its state."""
        return tuple(sorted(self._states.items()))

    def resume(self, states: Iterable[tuple[int, State]]) -> None:
        """Go on from saved states."""
        self._states.update(states)

    def _for_all(self, judgement: Judgement) -> bool:
        return self._part is not None and judgement.address == self._part.broadcast

    def _for_one(self, address: int) -> bool:
        """Whether a device can have that address, so that there is no end of them."""
        part = self._part
        return part is not None and part.low <= address <= part.high
