"""Draws random faults: a family, a trigger and an effect. A seed gives the same fault everywhere.

`random:SEED` is a trigger (frame, state, data, history, timing) and an effect. `random:SEED.NUMBER`
draws from wider families: also data of frames that are already faulty, frames in a certain context,
rhythms, settings in which the robot does not obey, and wheels that turn at another speed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.random_families import (
    disobedience,
    in_context,
    needle,
    rhythm,
    simple,
    wheels_astray,
)
from bilprov.spec.protocol import Protocol

PREFIX = "random:"
_FAMILIES = (
    *8 * (simple,),
    *4 * (needle,),
    *3 * (in_context,),
    *3 * (rhythm,),
    disobedience,
    wheels_astray,
)


@cache
def random_fault(protocol: Protocol, seed: int) -> Fault:
    """Return the fault `random:SEED`."""
    return replace(simple(protocol, Draw(seed)), name=f"{PREFIX}{seed}")


@cache
def drawn_fault(protocol: Protocol, seed: int, number: int) -> Fault:
    """Return the fault `random:SEED.NUMBER`, drawn from the wider families."""
    draw = Draw(f"{seed}.{number}")
    fault = draw.pick(_FAMILIES)(protocol, draw)
    return replace(fault, name=f"{PREFIX}{seed}.{number}")


def find_random_fault(protocol: Protocol, name: str) -> Fault:
    """Return the random fault of that name. Raises ValueError, in one sentence, for any other."""
    parts = name.removeprefix(PREFIX).split(".")
    numbers = [int(part) for part in parts if part.isascii() and part.isdigit()]
    if len(numbers) == len(parts) == 1:
        return random_fault(protocol, numbers[0])
    if len(numbers) == len(parts) == 2:
        return drawn_fault(protocol, *numbers)
    raise ValueError(
        f"there is no fault {name!r}; a random one is {PREFIX}SEED or {PREFIX}SEED.NUMBER, each a "
        f"whole number, for example {PREFIX}7 or {PREFIX}7.1"
    )
