"""Words for response codes, answers, states and looks, as judgements use them."""

from __future__ import annotations

from bilprov.captures.schemas import Look
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State


def code_words(protocol: Protocol, code: int) -> str:
    """A response code in hex and in words: `01 BAD_HEADER`."""
    known = protocol.codes.get(code)
    return f"{code:02x} {known.name if known else 'unused'}"


def answer_words(protocol: Protocol, codes: tuple[int, ...]) -> str:
    """A list of answers in hex and in words, long ones clipped."""
    if not codes:
        return "no answer"
    shown = ", ".join(code_words(protocol, code) for code in codes[:4])
    return f"{shown} and {len(codes) - 4} more" if len(codes) > 4 else shown


def state_words(state: State) -> str:
    """A motion state in words."""
    seen = f"{'moving ' if state.moving else ''}{visible_motion(state)}"
    others = (name for name in state.variables if name != state.wheels.by)
    return ", ".join((seen, *(f"{name} {getattr(state, name)}" for name in others)))


def look_words(look: Look) -> str:
    """A look in words; facets that the probe does not report are left out."""
    moving = {True: "moving", False: "stopped", None: "moving unknown"}[look.moving]
    motion = look.car.drive(look).motion
    facets = [moving] if motion in (None, look.car.still) else [f"{moving} {motion}"]
    for name in look.variables:
        value = getattr(look, name)
        if value is not None and name != look.car.by:
            facets.append(f"{name} {value}")
    if look.left is not None and look.right is not None:
        facets.append(f"wheels {look.left}/{look.right}")
    return ", ".join(facets)
