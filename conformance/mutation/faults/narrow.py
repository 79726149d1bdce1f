"""Faults triggered by one motion, value, bit, header or steering side alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from bilprov.conformance.dut.fault import Event, Fault, React
from bilprov.conformance.mutation.faults.vocabulary import (
    READING,
    SEQUENCE,
    Change,
    Condition,
    answers_with,
    becomes,
    carries,
    drives_on,
    every,
    faulty,
    is_named,
    is_outcome,
    is_truncated,
    keeps,
    moving_in,
    slug,
    stands_still,
    then,
    when,
    words,
)
from bilprov.spec.by_effect import moving_motions, setters, variable_of
from bilprov.spec.codec import bad_data
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import WHEELS, State
from bilprov.spec.protocol import FieldSpec, Protocol

_FAMILY = "narrow"


def narrow_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults that only one motion, value, bit, header or steering side triggers."""
    yield from _in_one_motion(protocol)
    yield from _at_one_value(protocol)
    yield from _at_one_bit(protocol)
    yield from _at_one_header(protocol)
    yield from _at_one_side(protocol)


def _in_one_motion(protocol: Protocol) -> Iterator[Fault]:
    ok = protocol.answers[Outcome.VALID].code
    motions = moving_motions(protocol)
    outcomes = [outcome for outcome in Outcome if outcome is not Outcome.VALID]
    for index, motion in enumerate(motions):
        moving, name = moving_in(motion), words(motion)
        outcome = outcomes[index % len(outcomes)]
        yield _fault(
            f"ok-to-faults-while-{name}",
            f"answers {protocol.answers[Outcome.VALID].name} to faults while it moves "
            f"{motion.value}, but stops",
            when(every(faulty, moving), answers_with(ok)),
            *("responses", "instructions"),
        )
        yield _fault(
            f"no-stop-on-{slug(outcome)}-while-{name}",
            f"{outcome.value} does not stop it while it moves {motion.value}",
            when(every(is_outcome(outcome), moving), drives_on),
            *("safety", "instructions"),
        )
        for setter in setters(protocol)[index % 4 :: 4]:
            yield _fault(
                f"{setter.name}-stops-it-while-{name}",
                f"{setter.name} stops it while it moves {motion.value}",
                when(every(is_named(setter), moving), stands_still),
                "instructions",
            )
        for setter in setters(protocol)[(index + 1) % 4 :: 4]:
            yield _fault(
                f"{setter.name}-ignored-while-{name}",
                f"{setter.name} is answered and ignored while it moves {motion.value}",
                when(every(is_named(setter), moving), keeps(variable_of(setter))),
                "instructions",
            )
    for motion in motions[-2:]:
        moving, name = moving_in(motion), words(motion)
        stop = protocol.stop
        yield _fault(
            f"{stop.name}-does-nothing-while-{name}",
            f"{stop.name} does nothing while it moves {motion.value}",
            when(every(is_named(stop), moving), drives_on),
            *("instructions", "safety"),
        )
        yield _fault(
            f"no-stop-on-truncated-while-{name}",
            f"a frame that is cut short does not stop it while it moves {motion.value}",
            when(every(is_truncated, moving), drives_on),
            *("safety", "responses", "instructions"),
        )
        for spec, value in _bad_values(protocol, motions.index(motion)):
            yield _fault(
                f"accepts-{spec}-{value}-while-{name}",
                f"takes {value}, bad data of {spec}, for good while it moves {motion.value}",
                when(every(_bad_value(spec, value), moving), then(drives_on, answers_with(ok))),
                *("instructions", "responses", "safety"),
                hints=(value,),
            )
    for setter in setters(protocol):
        yield _fault(
            f"{setter.name}-ignored-while-stopped",
            f"{setter.name} is answered and ignored while the robot stands",
            when(every(is_named(setter), _standing), keeps(variable_of(setter))),
            "instructions",
        )


def _at_one_value(protocol: Protocol) -> Iterator[Fault]:
    for setter in setters(protocol):
        part, variable = setter.fields[0], variable_of(setter)
        header = protocol.header_bytes[setter.id, setter.length]
        values = {part.low, (part.low + part.high + 1) // 2, header, part.high}
        if part.name == "speed":
            values.discard(part.high)  # the family `setting` has that fault: ignored-at-full
        for value in sorted(v for v in values if part.low <= v <= part.high):
            yield _fault(
                f"{setter.name}-{value}-ignored",
                f"{setter.name} with {value} is answered and ignored",
                when(carries(setter, value), keeps(variable)),
                "instructions",
                caught=("valid/*", "sequence/*"),
                hints=(value,),
            )
        if part.high > 127:
            yield _fault(
                f"{setter.name}-is-signed",
                f"{setter.name} takes values above 127 for negative ones",
                when(is_named(setter), becomes(_signed(variable))),
                "instructions",
            )


def _at_one_bit(protocol: Protocol) -> Iterator[Fault]:
    for setter in setters(protocol):
        part, variable = setter.fields[0], variable_of(setter)
        if part.bits:
            continue
        for bit in (0, 4, 7):
            yield _fault(
                f"{setter.name}-bit-{bit}-lost",
                f"{setter.name} loses bit {bit} of its data",
                when(is_named(setter), becomes(_with_bit(variable, bit, on=False))),
                "instructions",
            )
        yield _fault(
            f"{setter.name}-bit-1-stuck",
            f"{setter.name} reads bit 1 of its data as set, always",
            when(is_named(setter), becomes(_with_bit(variable, 1, on=True))),
            "instructions",
        )
    ok = protocol.answers[Outcome.VALID].code
    for spec in protocol.instructions:
        for part in spec.fields:
            if not part.bits or not list(bad_data(spec)):
                continue
            for bit in range(len(part.bits) + 1, 8 * part.size):
                yield _fault(
                    f"accepts-{spec.name}-bit-{bit}",
                    f"does not see bit {bit} of {spec.name}'s data: OK, the low bits shown",
                    when(_only_bit(spec.name, part, bit), _shows_low_bits(part, ok)),
                    *("instructions", "responses"),
                )
            yield _fault(
                f"ok-and-stop-on-{spec.name}-upper-bits",
                f"stops at bad data of {spec.name}, answers OK and shows the low bits",
                when(
                    is_outcome(Outcome.BAD_DATA),
                    then(answers_with(ok), becomes(_low_bits(part))),
                ),
                *("responses", "instructions"),
            )


def _at_one_header(protocol: Protocol) -> Iterator[Fault]:
    ok = protocol.answers[Outcome.VALID].code
    longest = protocol.data_lengths[-1]
    for index, identity in enumerate(protocol.unused_ids[1:-1]):
        length = (3 * index + 1) % (longest + 1)
        yield _fault(
            f"accepts-id-{identity}-with-{length}",
            f"takes the unused ID {identity} with {length} data bytes for an instruction",
            when(_header(identity, length), then(drives_on, answers_with(ok))),
            *("instructions", "safety"),
            caught=(f"unused-id/{identity}/{length}", f"truncated/{identity}/{length}/*"),
        )
    for spec in protocol.instructions[::2]:
        length = longest - spec.id % 4
        yield _fault(
            f"no-stop-on-{spec.name}-with-{length}",
            f"{spec.name} with {length} data bytes is refused and does not stop it",
            when(every(_header(spec.id, length), is_outcome(Outcome.TOO_MANY)), drives_on),
            *("safety", "responses"),
        )
    for length in (2, 7, 8):
        yield _fault(
            f"length-{length}-accepted",
            f"refuses no known ID that comes with {length} data bytes",
            when(
                every(_length(length), is_outcome(Outcome.TOO_MANY)),
                then(drives_on, answers_with(ok)),
            ),
            *("responses", "safety"),
        )
    few = protocol.answers[Outcome.TOO_FEW].code
    yield _fault(
        "longest-frame-is-too-few",
        f"answers {protocol.answers[Outcome.TOO_FEW].name} to a known ID with the most data bytes",
        when(every(_length(longest), is_outcome(Outcome.TOO_MANY)), answers_with(few)),
        "responses",
    )
    taken = setters(protocol)
    for one, other in zip(taken, [*taken[1:], *taken[:1]], strict=True):
        spoilt = variable_of(other)
        if spoilt != variable_of(one):
            yield _fault(
                f"{one.name}-spoils-{spoilt}",
                f"{one.name} overwrites the lowest bit of the {spoilt} too",
                when(is_named(one), becomes(_with_bit(spoilt, 0, on=True))),
                "instructions",
            )


def _at_one_side(protocol: Protocol) -> Iterator[Fault]:
    stop = protocol.stop
    if not stop.effect.sets("steering"):
        return
    for side, sign in (("right", 1), ("left", -1)):
        for name, condition in ((stop.name, is_named(stop)), ("fault", faulty)):
            what = f"{stop.name} resets" if name == stop.name else "a fault resets"
            yield _fault(
                f"{name}-keeps-steering-to-the-{side}",
                f"{what} the steering only where it is not to the {side}",
                when(every(condition, _steers_to(sign)), keeps("steering")),
                *("instructions", "safety"),
                caught=READING,
            )
    for motion in moving_motions(protocol):
        if WHEELS[motion][0] != WHEELS[motion][1]:
            continue
        yield _fault(
            f"{stop.name}-keeps-steering-while-{words(motion)}",
            f"{stop.name} resets the steering, but not while it moves {motion.value}",
            when(every(is_named(stop), moving_in(motion)), keeps("steering")),
            "instructions",
            caught=READING,
        )


def _fault(
    name: str,
    doc: str,
    react: React,
    *clauses: str,
    caught: tuple[str, ...] = SEQUENCE,
    hints: tuple[int, ...] = (),
) -> Fault:
    return Fault(name.lower(), _FAMILY, doc, caught, react=react, clauses=clauses, hints=hints)


def _standing(event: Event) -> bool:
    return not event.before.moving


def _steers_to(sign: int) -> Condition:
    return lambda event: event.before.steering * sign > 0


def _header(identity: int, length: int) -> Condition:
    return lambda event: event.judgement.id == identity and event.judgement.length == length


def _length(length: int) -> Condition:
    return lambda event: event.judgement.length == length


def _bad_values(protocol: Protocol, turn: int) -> Iterator[tuple[str, int]]:
    """Yield (name, value): one bad value of the first field of each instruction that has any."""
    for spec in protocol.instructions:
        values = list(bad_data(spec))
        if values:
            part = spec.fields[0]
            data = values[len(values) * (turn + 1) // 6]
            yield spec.name, part.parse(data[part.offset : part.offset + part.size])


def _bad_value(name: str, value: int) -> Condition:
    return lambda event: (
        event.judgement.outcome is Outcome.BAD_DATA
        and event.judgement.name == name
        and event.judgement.fields[0][1] == value
    )


def _only_bit(name: str, part: FieldSpec, bit: int) -> Condition:
    """Return a trigger: bad data in which this is the only bit set outside the range."""

    def condition(event: Event) -> bool:
        bad = event.judgement.outcome is Outcome.BAD_DATA and event.judgement.name == name
        return bad and event.judgement.fields[0][1] & ~part.high == 1 << bit

    return condition


def _low_bits(part: FieldSpec) -> Change:
    return lambda event, state: replace(state, led=event.judgement.fields[0][1] & part.high)


def _shows_low_bits(part: FieldSpec, ok: int) -> React:
    return then(drives_on, answers_with(ok), becomes(_low_bits(part)))


def _signed(variable: str) -> Change:
    def signed(event: Event, state: State) -> State:
        value = getattr(state, variable)
        size = abs(value)
        turned = (256 - size) * (-1 if value > 0 else 1) if size > 127 else value
        return replace(state, **{variable: abs(turned) if variable == "speed" else turned})

    return signed


def _with_bit(variable: str, bit: int, *, on: bool) -> Change:
    def changed(event: Event, state: State) -> State:
        value = getattr(state, variable)
        size = abs(value) | 1 << bit if on else abs(value) & ~(1 << bit)
        return replace(state, **{variable: -size if value < 0 else size})

    return changed
