"""Finds instructions and frames by their effect: which motion or variable they set.

`frames_to` is the search: the fewest frames that bring a robot from one state to another.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from operator import itemgetter
from typing import Any, NamedTuple

from bilprov.spec.codec import Steps, build, judge
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.state import Changed, From, State, Step, assigned, ways_on


def fitted(protocol: Protocol, spec: InstructionSpec, state: State) -> bytes:
    """Return the frame of an instruction that leads nearest to a state.

    A field that sets nothing has its lowest value.
    """
    return _built(protocol, spec.name, tuple(_fitted_values(spec, state).items()))


@lru_cache(maxsize=1 << 12)
def _built(protocol: Protocol, name: str, values: tuple[tuple[str, int], ...]) -> bytes:
    """The frame of an instruction with these values of its fields."""
    return build(protocol, name, dict(values))


def _fitted_values(spec: InstructionSpec, state: State) -> dict[str, int]:
    """The values of the fields in the frame that `fitted` builds."""
    values = {part.name: part.low for part in spec.fields}
    if not values:
        return values
    limits = {part.name: (part.low, part.high) for part in spec.fields}
    for variable, source in spec.effect.assignments:
        if isinstance(source, From):
            wanted = getattr(state, variable)
            number = round(wanted / source.factor) if source.factor else 0
            low, high = limits[source.field]
            values[source.field] = min(max(number, low), high)
    return values


def _set_by_fitted(spec: InstructionSpec, state: State) -> dict[str, Any]:
    """What the frame that `fitted` builds for a state sets in it; the frame itself takes long."""
    return {
        name: value.value(getattr(state, name)) if isinstance(value, Changed) else value
        for name, value in assigned(spec.effect, _fitted_values(spec, state))
    }


def after(spec: InstructionSpec, frame: bytes, state: State) -> State:
    """Return the state after a valid frame of the instruction."""
    return spec.effect.apply(state, spec.decode(frame[1:]))


@lru_cache(maxsize=1 << 12)
def setting(protocol: Protocol, variable: str, value: int, beside: State | None = None) -> bytes:
    """Return a frame that sets a variable and leaves the motion alone, b"" if there is none.

    Where it sets others too, they keep their value in `beside` (at power-on, if None) if they can.
    """
    state = (beside or protocol.power_on).but(**{variable: value})
    found: list[tuple[int, bytes]] = []
    for spec in protocol.instructions:
        if spec.effect.sets(variable) and not spec.effect.sets(protocol.car.by):
            frame = fitted(protocol, spec, state)
            changed = _differing(after(spec, frame, state), state)
            if variable not in changed:
                found.append((len(changed), frame))
    return min(found, key=itemgetter(0))[1] if found else b""


def _differing(one: State, other: State) -> frozenset[str]:
    """The variables in which two states differ."""
    return frozenset(name for name in one.variables if getattr(one, name) != getattr(other, name))


@lru_cache(maxsize=1 << 12)
def frames_to(protocol: Protocol, state: State, known: State | None = None) -> tuple[bytes, ...]:
    """Return the fewest frames that bring a robot as near to a state as they can.

    The robot stands still; of its other variables nothing is known, or they are those of `known`.
    What no instruction sets is left as it is. Of equally few frames those come first that set speed
    and LED, then the motion, then the steering: a device may take up a speed only at the next
    motion (R-speed-moving), and a motion may reset the steering (R-drive-steering,
    R-rotate-steering). Steering during a rotation may become a curve (R-steer-rotating): there it
    comes before the motion.
    """
    car, reached = protocol.car, _reached(protocol, state)
    wanted = _settable(protocol, state, reached)
    if wanted != state:
        reached = _reached(protocol, wanted)
    candidates = _candidates(protocol, wanted, reached)
    start = frozenset(state.variables) - _differing(known, wanted) if known else frozenset()
    start -= {car.by}
    if not protocol.directed(wanted):
        start |= {car.by}
    way = _way(start, tuple((sets, spoils) for _, sets, spoils in candidates), car.by, car.speed)
    return tuple(fitted(protocol, candidates[place][0], wanted) for place in way)


@lru_cache(maxsize=1 << 12)
def _way(
    start: frozenset[str],
    steps: tuple[tuple[frozenset[str], frozenset[str]], ...],
    by: str,
    speed: str,
) -> tuple[int, ...]:
    """The places of the fewest steps after which the most is right, the motion and the speed first.

    A step is the variables that are right after it, and those that are wrong.
    """
    numbered = [(place, sets, spoils) for place, (sets, spoils) in enumerate(steps)]
    ways = dict(ways_on(start, numbered))
    return ways[max(ways, key=lambda right: (by in right, speed in right, len(right)))]


def _reached(protocol: Protocol, state: State) -> dict[str, dict[str, Any]]:
    """What the fitted frame of each instruction sets in a state, by the instruction's name."""
    return {spec.name: _set_by_fitted(spec, state) for spec in protocol.instructions}


def _candidates(
    protocol: Protocol, wanted: State, reached: Mapping[str, Mapping[str, Any]]
) -> list[Step[InstructionSpec]]:
    """Instructions with the variables that they set as wanted, and otherwise, the best first."""
    car = protocol.car
    found = []
    for spec, touched in _in_order(protocol, car.rotates(car.drive(wanted).motion)):
        later = reached[spec.name].items()
        spoils = frozenset([name for name, value in later if value != getattr(wanted, name)])
        sets = touched - spoils
        if sets:
            found.append((spec, sets, spoils))
    return found


@lru_cache(maxsize=1 << 4)
def _in_order(
    protocol: Protocol, rotates: bool
) -> tuple[tuple[InstructionSpec, frozenset[str]], ...]:
    """The instructions that set variables, with these, in the order in which they are best sent.

    `rotates` where they lead to a rotation.
    """
    car = protocol.car
    late = (car.by, car.steering)
    order = (car.speed, *protocol.lights, *(reversed(late) if rotates else late))
    found = []
    for spec in protocol.instructions:
        touched = frozenset(name for name, _ in spec.effect.assignments)
        if touched:
            rank = min(map(order.index, {car.by} & touched or touched))
            found.append(((protocol.stops(spec.effect), rank), (spec, touched)))
    return tuple(one for _, one in sorted(found, key=itemgetter(0)))


def _settable(protocol: Protocol, state: State, reached: Mapping[str, Mapping[str, Any]]) -> State:
    """The state, each variable with the value nearest to its own that some instruction sets."""
    values: dict[str, Any] = {}
    for name in {*state.variables} - {protocol.car.by}:
        own, ends = getattr(state, name), [one[name] for one in reached.values() if name in one]
        values[name] = min(ends, key=lambda value: abs(value - own), default=own)
    return state.but(**values)


def reached(protocol: Protocol, state: State) -> State:
    """Return the state to which `frames_to` leads a stopped robot that was just switched on."""
    found = protocol.stop.effect.apply(protocol.power_on)
    for frame in frames_to(protocol, state):
        found = after(protocol.by_id[protocol.headers[frame[0]][0]], frame, found)
    return found


@lru_cache(maxsize=1 << 4)
def movers(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """Return the instructions that set the robot moving: for each motion those without data.

    Where each instruction that sets a motion takes data, these.
    """
    car = protocol.car
    found = [spec for spec in protocol.instructions if car.moves(spec.effect)]
    short = {car.motion(spec.effect) for spec in found if not spec.fields}
    return tuple(s for s in found if not s.fields or car.motion(s.effect) not in short)


@lru_cache(maxsize=1 << 4)
def moving_motions(protocol: Protocol) -> tuple[str, ...]:
    """Return the kinds of motion in which wheels turn that an instruction sets."""
    found = {protocol.car.motion(spec.effect) for spec in movers(protocol)}
    return tuple(m for m in protocol.variables[protocol.car.by].words if m in found)


def moving_to(protocol: Protocol, state: State) -> bytes:
    """Return the frame that sets a robot into the motion of a state, b"" if there is none."""
    car = protocol.car
    wanted = car.drive(state).motion
    found = (spec for spec in movers(protocol) if car.motion(spec.effect) == wanted)
    return next((fitted(protocol, spec, state) for spec in found), b"")


def setters(protocol: Protocol) -> tuple[InstructionSpec, ...]:
    """Return the instructions whose data set a variable and that leave the motion alone."""
    return tuple(
        s
        for s in protocol.instructions
        if s.fields and s.effect.assignments and not s.effect.sets(protocol.car.by)
    )


def variable_of(spec: InstructionSpec) -> str:
    """Return the (first) variable that an instruction sets."""
    return spec.effect.assignments[0][0]


class LinkCheck(NamedTuple):
    """The frames that tell whether a device answers on a line; none of them moves it.

    `setting` gives the speed half its range (a stop, where no instruction sets it). `unused` is the
    header of an unused ID and `short` that of the setting without its data; each is b"" where the
    protocol has none.
    """

    setting: bytes
    unused: bytes
    short: bytes


def link_check(protocol: Protocol, taken: int | None = None) -> LinkCheck:
    """Return the frames of the link check; `taken` is an unused ID to leave out."""
    frame = b""
    if protocol.wheels:
        frame = setting(protocol, protocol.car.speed, sum(protocol.speeds) // 2)
    frame = frame or bytes([protocol.pad_byte])
    identity, length = protocol.headers[frame[0]]
    free = [one for one in protocol.unused_ids if one != taken]
    unused = bytes([protocol.header_bytes[free[0], 0]]) if free else b""
    short = bytes([protocol.header_bytes[identity, 0]]) if length else b""
    return LinkCheck(frame, unused, short)


class Movement(NamedTuple):
    """What frames make a robot do; `speed` is the greatest that is set, None if none is."""

    motions: frozenset[str]
    speed: int | None


def all_movement(protocol: Protocol) -> Movement:
    """What the instructions of a protocol can make a robot do."""
    car = protocol.car
    motions = {car.motion(spec.effect) for spec in protocol.instructions}
    speed = protocol.speeds[1] if car.speed in protocol.limits else None
    return Movement(frozenset(m for m in car.turns if m in motions), speed)


def movement_of(protocol: Protocol, frames: Iterable[bytes]) -> Movement:
    """What these frames make a conforming robot do; faulty ones stop it.

    No more of them are taken once they do all that the protocol can.
    """
    car, every, steps = protocol.car, all_movement(protocol), Steps(protocol)
    found = Movement(frozenset(), None)
    for frame in frames:
        step = steps[frame]
        sets = dict(step.sets) if step.judgement.valid else {}
        new = sets.get(car.speed)
        fast = new.high if isinstance(new, Changed) else new
        speeds = [speed for speed in (found.speed, fast) if speed is not None]
        motions = found.motions.union(m for m in car.turns if m == sets.get(car.by))
        found = Movement(motions, max(speeds, default=None))
        if found == every:
            break
    return found


def movement_words(protocol: Protocol, movement: Movement) -> str:
    """What will move, how fast at most, and what to do before it does, in words."""
    car = protocol.car
    kinds = {car.rotates(motion): motion for motion in movement.motions}
    verbs = [verb for turning, verb in ((False, "drives"), (True, "turns")) if turning in kinds]
    words = f"it {' and '.join(verbs)}" if verbs else "it is sent no motion"
    if car.speed in protocol.limits:
        fast = f"speeds up to {movement.speed} of {protocol.speeds[1]}"
        if movement.speed is not None:
            words += f", at {fast}" if verbs else f", only {fast}"
        elif verbs:
            words += ", at the speed that it has"
    return f"{words}; its wheels should be off the ground"


_NOT_TOLD = "is not known, since the grammar declares no STATE and no `changes`"


def effect_words(protocol: Protocol, frames: Iterable[bytes] | None = None) -> str:
    """What frames may change in a device, in words; "" if they are known to change nothing.

    Without `frames` it is what all instructions may change. A car is said to drive and turn.
    """
    if protocol.wheels:
        if not all_movement(protocol).motions:
            return ""
        every = all_movement(protocol) if frames is None else movement_of(protocol, frames)
        return movement_words(protocol, every)
    judged = [judge(protocol, frame) for frame in dict.fromkeys(frames or ())]
    sent = [(one.instruction, dict(one.fields)) for one in judged if one.valid]
    every_one = [(spec, None) for spec in protocol.instructions]
    some: list[Any] = every_one if frames is None else sent
    words = [*_set_words(protocol, some), *_other_words(spec for spec, _ in some)]
    told = [f"it may {', '.join(words)}"] if words else []
    if some and not protocol.tells_changes:
        told.append(f"what the instructions change {_NOT_TOLD}")
    if len(sent) < len(judged):
        told.append("what the faulty instructions change is not known")
    return "; ".join(told)


def _set_words(protocol: Protocol, sent: Iterable[tuple[Any, Any]]) -> Iterator[str]:
    """What is set to what: of all values of the fields where these are None."""
    found: dict[str, list[Any]] = {}
    for instruction, fields in sent:
        for name, value in instruction.effect.assignments:
            ends = found.setdefault(name, [])
            if isinstance(value, From) and fields is None:
                ends += [word for word, _ in value.words] or protocol.limits[name]
            elif isinstance(value, From):
                ends.append(value.value(fields[value.field]))
            elif isinstance(value, Changed) or value is None:
                spec = protocol.variables[name]
                ends += spec.words or (spec.low, spec.high)
            else:
                ends.append(value)
    for name, values in found.items():
        if isinstance(values[0], str):
            yield f"set {name} to {' or '.join(dict.fromkeys(values))}"
        else:
            low, high = min(values), max(values)
            yield f"set {name} to {low}" + (f"..{high}" if high > low else "")


def _other_words(specs: Iterable[InstructionSpec]) -> Iterator[str]:
    """What is written besides the state, each once."""
    written = (spec.changes or (spec.writes.name if spec.writes else "") for spec in specs)
    yield from (f"write {name}" for name in dict.fromkeys(written) if name)


def change_by(protocol: Protocol, frame: bytes) -> str:
    """Why a frame is not known to change nothing, in words; "" if it only reads."""
    judged = judge(protocol, frame)
    if not judged.valid or judged.instruction is None:
        return f"{judged.describe()} is faulty, and what it changes is not known"
    if not protocol.tells_changes:
        return f"what {judged.instruction.name} changes {_NOT_TOLD}"
    spec = judged.instruction
    sets = [name for name, _ in spec.effect.assignments]
    changes = [*(f"sets {name}" for name in sets), *(f"may {w}" for w in _other_words([spec]))]
    return f"{judged.describe()} {', '.join(changes)}" if changes else ""
