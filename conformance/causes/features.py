"""What a cause may depend on: features of an exchange, from the protocol, and rules about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast
from typing import Literal as OneOf

from bilprov.captures.schemas import MS
from bilprov.conformance.causes.exchanges import (
    FAULTS,
    FRAMES,
    IN_A_ROW,
    MOVING,
    ROTATION,
    STOPPING,
    TRUNCATED,
    VALID,
    Exchange,
    value_of,
)
from bilprov.spec.motion import MOTIONS
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS

Value = str | int | None
Of = Callable[[Exchange], Value]


@dataclass(frozen=True, slots=True)
class Feature:
    """One thing that is known of each exchange.

    `of` gives its value: a word, a number, or None where the exchange has none. `cost` ranks
    features that explain equally well: the lower is named. `bits` is how many bits of a number may
    matter each for itself, `counts` whether every n-th may matter. Of one that `grows`, what is
    wrong at a number is wrong at all above. `words` has `{}` where the value stands; a `subject`
    names the frame itself.
    """

    name: str
    of: Of
    words: str
    cost: int = 1
    bits: int = 0
    counts: bool = False
    grows: bool = False
    subject: bool = False


def features(protocol: Protocol) -> tuple[Feature, ...]:
    """Return every feature of a protocol's exchanges."""
    return (
        *_of_frames(protocol),
        *_of_data(protocol),
        *_of_states(protocol),
        *_of_delivery(),
        *_of_history(protocol),
    )


def _of_frames(protocol: Protocol) -> Iterator[Feature]:
    yield Feature("frame", lambda e: e.kind, "{}", 0, subject=True)
    yield Feature("fault", _fault, "{}", 0, subject=True)
    yield Feature("stops", partial(_stops, protocol), "{}", 1, subject=True)
    yield Feature("outcome", lambda e: _whole(e, e.judgement.outcome.value), "{}", 0, subject=True)
    yield Feature("instruction", _instruction, "{}", 1, subject=True)
    yield Feature("cut", lambda e: "cut short" if e.step.truncated else "not cut short", "{}", 1)
    yield Feature("id", lambda e: e.judgement.id, "with ID {}", 2, protocol.ids[-1].bit_length())
    bits = protocol.data_lengths[-1].bit_length()
    yield Feature("length", lambda e: e.judgement.length, "with announced length {}", 2, bits)
    yield Feature("arrived", lambda e: len(e.step.frame) - 1, "with {} data bytes", 3)
    yield Feature("surplus", _surplus, "with {} data bytes too many", 3)


def _fault(exchange: Exchange) -> str:
    return "a faulty frame" if exchange.step.faulty else "a valid frame"


def _instruction(exchange: Exchange) -> str:
    judgement = exchange.judgement
    return f"any {judgement.name} frame" if judgement.instruction else "an unused ID"


def _stops(protocol: Protocol, exchange: Exchange) -> str:
    effect = exchange.step.frame_effect.effect
    if effect is None or protocol.stops(effect):
        return "a frame that stops it"
    moves = protocol.car.moment(effect) in MOTIONS
    return "a frame that moves it" if moves else "a frame that leaves its motion"


def _whole(exchange: Exchange, outcome: str) -> str | None:
    return None if exchange.step.truncated else outcome


def _surplus(exchange: Exchange) -> int | None:
    spec = exchange.judgement.instruction
    return None if spec is None else exchange.judgement.length - spec.length


def _of_data(protocol: Protocol) -> Iterator[Feature]:
    names = {part.name: part for spec in protocol.instructions for part in spec.fields}
    for name, part in names.items():
        width = max(abs(part.low), abs(part.high)).bit_length()
        yield Feature(name, _field(name), f"with {name} {{}}", 1, width)
    for index in range(1, protocol.data_lengths[-1] + 1):
        words = f"with data byte {index} {{}}"
        yield Feature(f"byte {index}", _byte(index), words, 2 if index == 1 else 4, 8)
    yield Feature("last byte", _last_byte, "with last data byte {}", 3, 8)


def _field(name: str) -> Of:
    return lambda exchange: dict(exchange.judgement.fields).get(name)


def _byte(index: int) -> Of:
    return lambda e: e.step.frame[index] if index < len(e.step.frame) else None


def _last_byte(exchange: Exchange) -> int | None:
    return exchange.step.frame[-1] if len(exchange.step.frame) > 1 else None


def _of_states(protocol: Protocol) -> Iterator[Feature]:
    for name, spec in protocol.variables.items():
        bits = 0 if spec.words else 8
        yield Feature(f"{name} before", _before(name), f"while {name} is {{}}", 2, bits)
        side = " to either side" if spec.low < 0 else ""
        yield Feature(f"{name} after", _after(name), f"then with {name} {{}}{side}", 3)
    yield Feature("moving before", _moved, "while it {}", 2)
    yield Feature("motion set", _set_to_move, "while {}", 2)


def _before(name: str) -> Of:
    def of(exchange: Exchange) -> Value:
        known = name not in exchange.before.unknown
        return getattr(exchange.before.state, name) if known else None

    return of


def _after(name: str) -> Of:
    def of(exchange: Exchange) -> Value:
        value = value_of(name, exchange.after)
        return abs(value) if isinstance(value, int) else value

    return of


def _moved(exchange: Exchange) -> str | None:
    car = exchange.before.state.wheels
    if exchange.before.unknown & {car.by, car.speed}:
        return None
    return "moves" if exchange.before.state.moving else "stands"


def _set_to_move(exchange: Exchange) -> str | None:
    """Whether a motion is set, which may show nothing where the speed is 0."""
    car = exchange.before.state.wheels
    if car.by in exchange.before.unknown:
        return None
    still = car.drive(exchange.before.state).motion == car.still
    return "no motion is set" if still else "a motion is set"


def _of_delivery() -> Iterator[Feature]:
    yield Feature("sent ahead", lambda e: "sent ahead" if e.ahead else "not sent ahead", "{}", 2)
    ahead = "with {} frames before it not answered yet"
    yield Feature("ahead", lambda e: e.ahead, ahead, 3, grows=True)
    in_one_go = "with {} bytes sent in one go"
    yield Feature("in one go", lambda e: e.in_one_go, in_one_go, 3, grows=True)
    yield Feature("looked", _looked, "{}", 3)
    yield Feature("split", lambda e: "sent in pieces" if e.pauses else "sent in one piece", "{}", 2)
    yield Feature("pause", lambda e: e.pause // MS, "with a pause of {} ms inside", 5)
    yield Feature("gap", lambda e: e.gap and e.gap // MS, "{} ms after the frame before", 5)


def _looked(exchange: Exchange) -> str | None:
    return "until the next frame" if exchange.looked else None


def _of_history(protocol: Protocol) -> Iterator[Feature]:
    yield Feature(
        "previous", lambda e: e.previous.kind if e.previous else "power-on", "sent after {}", 2
    )
    yield Feature("previous fault", _of_previous(_fault), "sent after {}", 2)
    named = _of_previous(lambda before: before.judgement.name)
    yield Feature("previous instruction", named, "sent after {}, right or wrong", 4)
    moved = "with the frame before it sent while it {}"
    yield Feature("moving before the previous", _of_previous(_moved), moved, 3)
    for name in (name for name, spec in protocol.variables.items() if spec.words):
        words = f"with the frame before it sent while {name} is {{}}"
        yield Feature(f"{name} before the previous", _of_previous(_before(name)), words, 3)
    kinds = [FAULTS, VALID, TRUNCATED, *(s.name for s in protocol.instructions)]
    for kind in (FRAMES, *kinds, STOPPING, MOVING, *POINTS):
        name = kind if kind in (FRAMES, FAULTS) else f"{kind} frames"
        words = f"with {{}} {name} before it since power-on"
        yield Feature(name, _times(kind), words, 6 if kind == FRAMES else 5, counts=True)
    kinds += [IN_A_ROW, ROTATION]
    yield Feature("row", lambda e: e.history.row, "with {} faults in a row before it", 3)
    for kind in kinds:
        words = f"{{}} frames after the last {_LAST.get(kind, kind)}"
        yield Feature(f"since {kind}", _since(kind), words, 6)
    for one in kinds:
        for other in kinds:
            if one < other:
                yield Feature(f"{one}/{other}", _later(one, other), "{}", 5)


def _of_previous(of: Of) -> Of:
    return lambda exchange: of(exchange.previous) if exchange.previous else None


def _times(kind: str) -> Of:
    return lambda exchange: exchange.history.times.get(kind, 0)


def _since(kind: str) -> Of:
    def of(exchange: Exchange) -> Value:
        last = exchange.history.last.get(kind)
        return None if last is None else exchange.history.frames - last

    return of


_LAST = {FAULTS: "fault", VALID: "valid frame", TRUNCATED: "truncated frame"}
_ONE = {kind: f"a {words}" for kind, words in (*_LAST.items(), (ROTATION, ROTATION))}


def _later(one: str, other: str) -> Of:
    def of(exchange: Exchange) -> Value:
        last = exchange.history.last
        first, second = last.get(one, -1), last.get(other, -1)
        late, early = (one, other) if first > second else (other, one)
        words, others = _LAST.get(early, early), _LAST.get(late, late)
        if first != second:
            return f"with {_ONE.get(late, late)} since the last {words}"
        return None if first < 0 else f"with the last {words} also the last {others}"

    return of


Operator = OneOf["is", "in", "from", "to", "bit", "no bit", "every"]


_FITS: dict[Operator, Callable[[Any, Any], Any]] = {
    "is": lambda found, value: found == value,
    "in": lambda found, words: found in words,
    "from": lambda found, least: found >= least,
    "to": lambda found, most: found <= most,
    "bit": lambda found, bit: abs(found) >> bit & 1 == 1,
    "no bit": lambda found, bit: abs(found) >> bit & 1 == 0,
    "every": lambda found, period: found % period[0] == period[1],
}


class Literal(NamedTuple):
    """A condition on one feature.

    `is` a value, one `in` several words, `from` or `to` a number on, a `bit` set or not, or
    `every` n-th, r of it.
    """

    feature: Feature
    operator: Operator
    value: str | int | tuple[str, ...] | tuple[int, int]

    @property
    def words(self) -> tuple[str, ...]:
        """The words that its feature may have, none where it is about a number."""
        if self.operator == "in":
            return cast("tuple[str, ...]", self.value)
        return (self.value,) if isinstance(self.value, str) else ()

    @property
    def cost(self) -> int:
        """How much it takes to say it."""
        return self.feature.cost + (len(self.words) if self.operator == "in" else 0)

    def holds(self, exchange: Exchange) -> bool:
        """Return whether the condition holds for an exchange."""
        return bool(self.fits(self.feature.of(exchange)))

    @property
    def period(self) -> int:
        """The n of every n-th."""
        return cast("tuple[int, int]", self.value)[0]

    def missing(self, exchange: Exchange) -> int:
        """How many frames more its feature must count until it is one of every n-th."""
        _, rest = cast("tuple[int, int]", self.value)
        return (rest - cast("int", self.feature.of(exchange))) % self.period

    def fits(self, found: Any) -> Any:
        """Return whether the condition holds for a value of the feature, or for each of an array.

        Arrays are of numbers.
        """
        return False if found is None else _FITS[self.operator](found, self.value)


Rule = tuple[Literal, ...]


def matches(rule: Rule, exchange: Exchange) -> bool:
    """Return whether a rule takes in an exchange."""
    return all(literal.holds(exchange) for literal in rule)
