"""Draws the triggers of random faults: a frame, and a state, data, history or timing."""

from __future__ import annotations

from typing import NamedTuple

from bilprov.captures.schemas import MS
from bilprov.captures.text import ordinal
from bilprov.conformance.dut.fault import Event
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    Condition,
    after,
    after_a_fault,
    every_nth,
    faulty,
    from_count,
    has_id,
    has_length,
    is_named,
    is_outcome,
    is_truncated,
    moving_in,
    pipelined,
    split,
    standing,
    steered_to,
)
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol


class What(NamedTuple):
    """The frames that trigger a fault: their description, the condition, and their kind.

    `spec` is the instruction of valid frames, None for faulty ones; `outcome` is their kind of
    fault, None for any; `cut` is true for truncated frames.
    """

    words: str
    condition: Condition
    spec: InstructionSpec | None = None
    outcome: Outcome | None = None
    cut: bool = False


class When(NamedTuple):
    """A further condition of the trigger, its words, and data around which it holds.

    `hints` are those of `Fault`.
    """

    words: str
    condition: Condition
    hints: tuple[int | bytes, ...] = ()


def frames(protocol: Protocol, draw: Draw) -> What:
    """Draw the frames: valid ones of an instruction, a kind of fault, cut ones, or any fault."""
    kind = draw.below(10)
    if kind < 5:
        spec = draw.pick(protocol.instructions)
        return What(f"a valid {spec.name}", is_named(spec), spec)
    if kind < 7:
        outcome = draw.pick(FAULTY)
        return What(outcome.value, is_outcome(outcome), outcome=outcome)
    if kind == 7:
        return What("a frame that is cut short", is_truncated, cut=True)
    if kind == 8 and protocol.unused_ids:
        identity = draw.pick(protocol.unused_ids)
        words = f"the unused ID {identity}"
        return What(words, has_id(identity), outcome=Outcome.UNKNOWN_ID)
    return What("any fault", faulty)


def has_data(what: What) -> bool:
    """Return whether such frames carry data that a further condition may be about."""
    return bool(what.spec.fields) if what.spec else not what.cut


def in_a_state(protocol: Protocol, draw: Draw, what: What) -> When:
    """Draw a state before the frame that there can be: a motion, a speed, a steering, a light."""
    limits = protocol.limits
    fast = [_fast] if limits.get("speed", (0, 0))[1] > 0 else []
    starts = what.spec is not None and what.spec.effect.motion is not Motion.STOPPED
    kinds = [
        *(3 * [_moving] if moving_motions(protocol) else []),
        *([_standing] if starts else fast),
        *fast,
        *([_steered] if any(limits.get("steering", ())) else []),
        *([_lit] if limits.get("led", (0, 0))[1] else []),
    ]
    return draw.pick(kinds or [_standing])(protocol, draw)


def _moving(protocol: Protocol, draw: Draw) -> When:
    motion = draw.pick(moving_motions(protocol))
    return When(f"while it moves {motion.value}", moving_in(motion))


def _standing(protocol: Protocol, draw: Draw) -> When:
    return When("while it stands", standing)


def _fast(protocol: Protocol, draw: Draw) -> When:
    least = draw.between(1, protocol.limits["speed"][1])
    return When(
        f"at a speed from {least}", lambda event: event.before.speed >= least, (least, least - 1)
    )


def _steered(protocol: Protocol, draw: Draw) -> When:
    ends = protocol.limits["steering"]
    sign = draw.pick([sign for sign in (-1, 1) if any(end * sign > 0 for end in ends)])
    side = "right" if sign > 0 else "left"
    return When(f"steered to the {side}", steered_to(sign))


def _lit(protocol: Protocol, draw: Draw) -> When:
    mask = 1 << draw.below(protocol.limits["led"][1].bit_length())
    return When(
        f"with the light's bit {mask:#x} on", lambda event: bool(event.before.led & mask), (mask,)
    )


def with_data(protocol: Protocol, draw: Draw, what: What) -> When:
    """Draw data of the frame: a value, a threshold, a bit; or what a faulty header announces."""
    if what.spec is None:
        if what.outcome is Outcome.BAD_DATA:
            bit = draw.below(8)
            return When(
                f"with bit {bit} of its data",
                lambda event: _value(event) >> bit & 1 == 1,
                (1 << bit,),
            )
        if draw.below(2):
            odd = draw.below(2)
            words = "an odd" if odd else "an even"
            return When(
                f"with {words} announced length", lambda event: event.judgement.length % 2 == odd
            )
        length = draw.pick(protocol.data_lengths)
        return When(f"with {length} data bytes announced", has_length(length))
    part = what.spec.fields[0]
    kind = draw.below(4)
    if kind == 0:
        value = draw.between(part.low, part.high)
        return When(f"with the value {value}", lambda event: _value(event) == value, (value,))
    if kind == 1 and part.low < part.high:
        least = draw.between(part.low + 1, part.high)
        return When(
            f"with a value from {least}", lambda event: _value(event) >= least, (least, least - 1)
        )
    bit = draw.below(max(1, part.high.bit_length()))
    on = draw.below(2)
    words = "set" if on else "clear"
    return When(
        f"with bit {bit} {words}", lambda event: _value(event) >> bit & 1 == on, (1 << bit, 0)
    )


def _value(event: Event) -> int:
    fields = event.judgement.fields
    return fields[0][1] if fields else 0


def with_history(protocol: Protocol, draw: Draw, what: What) -> When:
    """Draw what came before: a frame, a fault, a count."""
    kind = draw.below(7)
    if kind < 3:
        spec = draw.pick(protocol.instructions)
        return When(f"right after {spec.name}", after(spec))
    if kind == 3:
        return When("right after a fault", after_a_fault)
    if kind == 4:
        step = draw.between(2, 40)
        return When(f"as every {ordinal(step)} frame", every_nth("frames", step))
    if kind == 5:
        count = draw.between(5, 250)
        return When(f"after {count} frames", from_count("frames", count))
    count = draw.between(2, 60)
    return When(f"after {count} faults", from_count("faults", count))


def with_timing(protocol: Protocol, draw: Draw, what: What) -> When:
    """Draw a delivery: sent ahead, after a pause, split."""
    carries = what.spec.length if what.spec else 2
    kind = draw.below(3 if carries and not what.cut else 2)
    if kind == 0:
        return When("sent ahead of the answer before", pipelined)
    if kind == 1:
        pause = draw.pick((15, 30, 60))
        return When(
            f"after {pause} ms without a frame",
            lambda event: event.gap is not None and event.gap >= pause * MS,
        )
    return When("with a pause between its bytes", split)
