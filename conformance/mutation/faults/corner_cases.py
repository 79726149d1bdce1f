"""Faults in corner cases: triggered by one motion, value, bit, header or steering side alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, React
from bilprov.conformance.mutation.faults.family import READING, Family, slug, words
from bilprov.conformance.mutation.faults.vocabulary import (
    FAULTY,
    Condition,
    accepts,
    answers_as,
    answers_ok,
    becomes,
    carries,
    clears_bit,
    drives_on,
    every,
    faulty,
    has_id,
    has_length,
    is_named,
    is_outcome,
    is_truncated,
    keeps,
    moving_in,
    sets_bit,
    shows_low_bits,
    standing,
    stands_still,
    steered_to,
    then,
    when,
)
from bilprov.spec.by_effect import moving_motions, setters, variable_of
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import State, rotates
from bilprov.spec.protocol import Protocol

narrow_fault = Family("narrow", "instructions")
steering_fault = Family("narrow", "instructions safety", READING)


def narrow_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that only one motion, value, bit, header or steering side triggers."""
    yield from _in_one_motion(protocol)
    yield from _at_one_value(protocol)
    yield from _at_one_bit(protocol)
    yield from _at_one_header(protocol)
    yield from _at_one_side(protocol)


def _in_one_motion(protocol: Protocol) -> Iterator[Fault]:
    motions, stop = moving_motions(protocol), protocol.stop
    for index, motion in enumerate(motions):
        moving, name = moving_in(motion), words(motion)
        outcome = FAULTY[index % len(FAULTY)]
        yield narrow_fault(
            f"ok-to-faults-while-{name}",
            f"answers {protocol.answers[Outcome.VALID].name} to faults while it moves "
            f"{motion.value}, but stops",
            when(every(faulty, moving), answers_ok),
            clauses="responses instructions",
        )
        yield narrow_fault(
            f"no-stop-on-{slug(outcome)}-while-{name}",
            f"{outcome.value} does not stop it while it moves {motion.value}",
            when(every(is_outcome(outcome), moving), drives_on),
            clauses="safety instructions",
        )
        for setter in setters(protocol)[index % 4 :: 4]:
            yield narrow_fault(
                f"{setter.name}-stops-it-while-{name}",
                f"{setter.name} stops it while it moves {motion.value}",
                when(every(is_named(setter), moving), stands_still),
            )
        for setter in setters(protocol)[(index + 1) % 4 :: 4]:
            yield narrow_fault(
                f"{setter.name}-ignored-while-{name}",
                f"{setter.name} is answered and ignored while it moves {motion.value}",
                when(every(is_named(setter), moving), keeps(variable_of(setter))),
            )
    for motion in motions[-2:]:
        moving, name = moving_in(motion), words(motion)
        yield narrow_fault(
            f"{stop.name}-does-nothing-while-{name}",
            f"{stop.name} does nothing while it moves {motion.value}",
            when(every(is_named(stop), moving), drives_on),
            clauses="instructions safety",
        )
        yield narrow_fault(
            f"no-stop-on-truncated-while-{name}",
            f"a frame that is cut short does not stop it while it moves {motion.value}",
            when(every(is_truncated, moving), drives_on),
            clauses="safety responses instructions",
        )
        for spec, value in _bad_values(protocol, motions.index(motion)):
            yield narrow_fault(
                f"accepts-{spec}-{value}-while-{name}",
                f"takes {value}, bad data of {spec}, for good while it moves {motion.value}",
                when(every(_bad_value(spec, value), moving), accepts),
                clauses="instructions responses safety",
                hints=(value,),
            )
    for setter in setters(protocol):
        yield narrow_fault(
            f"{setter.name}-ignored-while-stopped",
            f"{setter.name} is answered and ignored while the robot stands",
            when(every(is_named(setter), standing), keeps(variable_of(setter))),
        )


def _at_one_value(protocol: Protocol) -> Iterator[Fault]:
    for setter in setters(protocol):
        part, variable = setter.fields[0], variable_of(setter)
        header = protocol.header_bytes[setter.id, setter.length]
        values = {part.low, (part.low + part.high + 1) // 2, header, part.high}
        if part.name == "speed":
            values.discard(part.high)  # the family `setting` has that fault: ignored-at-full
        for value in sorted(v for v in values if part.low <= v <= part.high):
            yield narrow_fault(
                f"{setter.name}-{value}-ignored",
                f"{setter.name} with {value} is answered and ignored",
                when(carries(setter, value), keeps(variable)),
                caught_by=("valid/*", "sequence/*"),
                hints=(value,),
            )
        if part.high > 127:
            yield narrow_fault(
                f"{setter.name}-is-signed",
                f"{setter.name} takes values above 127 for negative ones",
                when(is_named(setter), _signed(variable)),
            )


def _at_one_bit(protocol: Protocol) -> Iterator[Fault]:
    for setter in setters(protocol):
        part, variable = setter.fields[0], variable_of(setter)
        if part.bits:
            continue
        for bit in (0, 4, 7):
            yield narrow_fault(
                f"{setter.name}-bit-{bit}-lost",
                f"{setter.name} loses bit {bit} of its data",
                when(is_named(setter), clears_bit(variable, bit)),
            )
        yield narrow_fault(
            f"{setter.name}-bit-1-stuck",
            f"{setter.name} reads bit 1 of its data as set, always",
            when(is_named(setter), sets_bit(variable, 1)),
        )
    for spec in protocol.instructions:
        for part in spec.fields:
            if not part.bits or not list(bad_data(spec)):
                continue
            low_bits = shows_low_bits(part.high)
            for bit in range(len(part.bits) + 1, 8 * part.size):
                yield narrow_fault(
                    f"accepts-{spec.name}-bit-{bit}",
                    f"does not see bit {bit} of {spec.name}'s data: OK, the low bits shown",
                    when(_bad_value(spec.name, 1 << bit, ~part.high), then(accepts, low_bits)),
                    clauses="instructions responses",
                )
            yield narrow_fault(
                f"ok-and-stop-on-{spec.name}-upper-bits",
                f"stops at bad data of {spec.name}, answers OK and shows the low bits",
                when(is_outcome(Outcome.BAD_DATA), then(answers_ok, low_bits)),
                clauses="responses instructions",
            )


def _at_one_header(protocol: Protocol) -> Iterator[Fault]:
    too_many = is_outcome(Outcome.TOO_MANY)
    longest = protocol.data_lengths[-1]
    for index, identity in enumerate(protocol.unused_ids[1:-1]):
        length = (3 * index + 1) % (longest + 1)
        yield narrow_fault(
            f"accepts-id-{identity}-with-{length}",
            f"takes the unused ID {identity} with {length} data bytes for an instruction",
            when(every(has_id(identity), has_length(length)), accepts),
            clauses="instructions safety",
            caught_by=(f"unused-id/{identity}/{length}", f"truncated/{identity}/{length}/*"),
        )
    for spec in protocol.instructions[::2]:
        length = longest - spec.id % 4
        yield narrow_fault(
            f"no-stop-on-{spec.name}-with-{length}",
            f"{spec.name} with {length} data bytes is refused and does not stop it",
            when(every(has_id(spec.id), has_length(length), too_many), drives_on),
            clauses="safety responses",
        )
    for length in (2, 7, 8):
        yield narrow_fault(
            f"length-{length}-accepted",
            f"refuses no known ID that comes with {length} data bytes",
            when(every(has_length(length), too_many), accepts),
            clauses="responses safety",
        )
    yield narrow_fault(
        "longest-frame-is-too-few",
        f"answers {protocol.answers[Outcome.TOO_FEW].name} to a known ID with the most data bytes",
        when(every(has_length(longest), too_many), answers_as(Outcome.TOO_FEW)),
        clauses="responses",
    )
    taken = setters(protocol)
    for one, other in zip(taken, [*taken[1:], *taken[:1]], strict=True):
        spoilt = variable_of(other)
        if spoilt != variable_of(one):
            yield narrow_fault(
                f"{one.name}-spoils-{spoilt}",
                f"{one.name} overwrites the lowest bit of the {spoilt} too",
                when(is_named(one), sets_bit(spoilt, 0)),
            )


def _at_one_side(protocol: Protocol) -> Iterator[Fault]:
    stop = protocol.stop
    if not stop.effect.sets("steering"):
        return
    for side, sign in (("right", 1), ("left", -1)):
        for name, subject, condition in (
            (stop.name, stop.name, is_named(stop)),
            ("fault", "a fault", faulty),
        ):
            yield steering_fault(
                f"{name}-keeps-steering-to-the-{side}",
                f"{subject} resets the steering only where it is not to the {side}",
                when(every(condition, steered_to(sign)), keeps("steering")),
            )
    for motion in moving_motions(protocol):
        if not rotates(motion):
            yield steering_fault(
                f"{stop.name}-keeps-steering-while-{words(motion)}",
                f"{stop.name} resets the steering, but not while it moves {motion.value}",
                when(every(is_named(stop), moving_in(motion)), keeps("steering")),
                clauses="instructions",
            )


def _bad_values(protocol: Protocol, turn: int) -> Iterator[tuple[str, int]]:
    """Yield (name, value): one bad value of the first field of each instruction that has any."""
    for spec in protocol.instructions:
        values = list(bad_data(spec))
        if values:
            data = values[len(values) * (turn + 1) // 6]
            yield spec.name, spec.decode(data)[spec.fields[0].name]


def _bad_value(name: str, value: int, mask: int = -1) -> Condition:
    """Return a trigger: bad data of that instruction, with this value in the bits of the mask."""
    return lambda event: (
        event.judgement.outcome is Outcome.BAD_DATA
        and event.judgement.name == name
        and event.judgement.fields[0][1] & mask == value
    )


def _signed(variable: str) -> React:
    """Return an effect: sizes above 127 count as negative; a speed stays positive."""

    def signed(event: Event, state: State) -> State:
        value = getattr(state, variable)
        size = abs(value)
        turned = (256 - size) * (-1 if value > 0 else 1) if size > 127 else value
        return replace(state, **{variable: abs(turned) if variable == "speed" else turned})

    return becomes(signed)
