"""How a wrong value relates to the right one: what a device does instead of what it should.

A relation predicts the wrong value. Where it predicts the right one, a right exchange says nothing
about it: a setting that is ignored shows only where it would change something.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from bilprov.conformance.causes.exchanges import (
    ANSWER,
    ASTRAY,
    MOTION,
    WHEELS,
    Bag,
    Exchange,
    value_of,
)

READS_DATA = "takes its data bytes for frames"
_MOST = 0.5
"""The share of clear deviations that a relation for them must explain."""
RESUMES = "is again what it was before the fault"
Value = int | str | None
Predict = Callable[[Exchange], Value]


@dataclass(frozen=True, slots=True)
class Relation:
    """What goes wrong in one facet, in words, and the value that it predicts for an exchange.

    `how` is that of the deviations. Where `predict` is None the value can be any. `seen` is the
    value where it is always the same.
    """

    facet: str
    how: str
    words: str
    predict: Predict | None = None
    seen: Value = None

    def explains(self, bag: Bag) -> bool:
        """Return whether a bag's deviation is of this kind."""
        return any(self.fits(bag, exchange) for exchange in bag.exchanges)

    def fits(self, bag: Bag, exchange: Exchange) -> bool:
        """Return whether the deviation is of this kind, if this exchange has caused it."""
        return self.predict is None or self.predict(exchange) == bag.deviation.seen

    def shows(self, exchange: Exchange, watched: int) -> bool:
        """Return whether a right exchange speaks against it: it would have shown there.

        `watched` is how long (ns) it takes to show.
        """
        facet = WHEELS if self.seen == ASTRAY else self.facet
        if facet not in exchange.right or exchange.watched < watched:
            return False
        return self.differs(exchange)

    def differs(self, exchange: Exchange) -> bool:
        """Return whether the value that it predicts for an exchange is not the right one."""
        if self.predict is None:
            return True
        predicted = self.predict(exchange)
        if predicted is None:
            return False
        return predicted != value_after(self.facet, exchange)


@dataclass(slots=True)
class Effect:
    """What goes wrong in one facet, the bags that show it and the right exchanges against it."""

    relation: Relation
    bags: list[Bag]
    against: list[Exchange]
    only_setters: bool = False

    @property
    def groups(self) -> list[tuple[Exchange, ...]]:
        """The exchanges of each bag that may have caused it."""
        return [self._group(bag) for bag in self.bags]

    @property
    def evidence(self) -> int:
        """How many exchanges tell where it shows and where not: one kind alone tells nothing."""
        return min(len(self.bags), len(self.against))

    def _group(self, bag: Bag) -> tuple[Exchange, ...]:
        fitting = tuple(e for e in bag.exchanges if self.relation.fits(bag, e)) or bag.exchanges
        if not self.only_setters:
            return fitting
        return tuple(e for e in fitting if e.sets(self.relation.facet)) or fitting

    def at_setters(self) -> Effect:
        """The effect, caused by frames that set the facet in which it shows, where there are any.

        It is the likeliest explanation of a wrong setting.
        """
        return replace(self, only_setters=True)

    def where_seen(self) -> Effect:
        """The effect without right exchanges before which nobody had looked at the facet.

        What it was there, a fault may have changed.
        """
        seen = [e for e in self.against if self.relation.facet not in e.assumed]
        return replace(self, against=seen)

    @property
    def takes_data(self) -> bool:
        """Whether data bytes are taken for frames, so that others begin elsewhere, too."""
        return self.relation.words == READS_DATA

    @property
    def comes_back(self) -> bool:
        """Whether it shows at no fault but right behind another: the first one stops the device."""
        shown = (bag.exchanges[-1] for bag in self.bags)
        return all(not e.step.faulty or (e.previous and e.previous.step.faulty) for e in shown)

    @property
    def keeps_moving(self) -> bool:
        """Whether the device moves where it must stand: what matters most."""
        return any(bag.keeps_moving for bag in self.bags)


def value_after(facet: str, exchange: Exchange) -> Value:
    """Return the right value of a facet after an exchange, None where it is not known.

    Of the answer it is the code, None for no answer.
    """
    if facet == ANSWER:
        return next(iter(exchange.accepted), None)
    return value_of(facet, exchange.after)


def relations(bags: Sequence[Bag]) -> list[tuple[Relation, list[Bag]]]:
    """Return the fewest relations that explain these bags (of one facet and one `how`)."""
    found = []
    left = list(bags)
    while left:
        facet, how = left[0].deviation[:2]
        candidates = _of_answers(how, left) if facet == ANSWER else _of_values(facet, how, left)
        scored = [(relation, [b for b in left if relation.explains(b)]) for relation in candidates]
        best = max(scored, key=lambda pair: len(pair[1]))
        if len(best[1]) < min(len(left), max(2, len(left) / 20)):
            best = Relation(facet, how, "is wrong" if facet != ANSWER else "answers wrongly"), left
        found.append(best)
        explained = set(map(id, best[1]))
        left = [bag for bag in left if id(bag) not in explained]
    return found


def _of_answers(how: str, bags: Sequence[Bag]) -> list[Relation]:
    running = Relation(ANSWER, how, READS_DATA, _running)
    clear = [bag for bag in bags if _clear(bag.exchanges[-1])] if how == "extra" else []
    if clear and sum(map(running.explains, clear)) > _MOST * len(clear):
        return [running]
    if how != "other":
        words = {
            "silent": "gives no answer",
            "extra": "answers more than once",
            "late": "answers late",
        }
        return [Relation(ANSWER, how, words[how])]
    codes = Counter(bag.deviation.seen for bag in bags).most_common(4)
    return [
        *_instead(ANSWER, how, bags),
        *(Relation(ANSWER, how, f"answers {code:#04x}", lambda e, c=code: c) for code, _ in codes),  # type: ignore[misc]
        Relation(ANSWER, how, "answers what was due to the frame before", _due_before),
    ]


def _clear(exchange: Exchange) -> bool:
    """Whether no answer can be that to a frame before."""
    before = exchange.previous
    return not exchange.ahead and (before is None or bool(before.right and not before.deviations))


def _running(exchange: Exchange) -> Value:
    """How many answers come where its data bytes are taken for frames, None where no more do.

    Nor is it known where an answer may be that to a frame before.
    """
    if exchange.step.truncated or not _clear(exchange):
        return None
    ways = exchange.as_frames(exchange.step.frame[1:])
    more = tuple(code for _, code in exchange.codes[1:])
    if all(ways) or (more and more in ways):
        return f"{1 + (len(more) if more in ways else max(map(len, ways)))} answers"
    return None


def _instead(facet: str, how: str, bags: Iterable[Bag]) -> Iterator[Relation]:
    """A value of its own instead of each that is right, where several are exchanged for others."""
    pairs = Counter((bag.deviation.expected, bag.deviation.seen) for bag in bags)
    found = {right: seen for (right, seen), _ in reversed(pairs.most_common())}
    if len(set(found.values())) > 1:
        exchanged = ", ".join(f"{seen} instead of {right}" for right, seen in found.items())
        words = "exchanges codes" if facet == ANSWER else f"is {exchanged}"
        yield Relation(facet, how, words, lambda e: found.get(value_after(facet, e)))


def _due_before(exchange: Exchange) -> Value:
    before = exchange.previous
    return next(iter(before.accepted), None) if before and len(before.accepted) == 1 else None


def _of_values(facet: str, how: str, bags: Sequence[Bag]) -> list[Relation]:
    def before(exchange: Exchange) -> Value:
        return value_of(facet, exchange.before)

    found = [Relation(facet, how, "stays as it was", before)]
    seen = Counter(bag.deviation.seen for bag in bags).most_common(3)
    if facet == MOTION:
        found += [Relation(facet, how, f"is {v}", _moving_as(v), v) for v, _ in seen]
        back = (resuming(facet, how), resuming(facet, how, later=True))
        return [*found, *_instead(facet, how, bags), *back]
    found += [Relation(facet, how, f"is {value}", lambda e, v=value: v) for value, _ in seen]  # type: ignore[misc]
    return found + [
        Relation(facet, how, words, _changed(facet, change)) for words, change in _changes(bags)
    ]


def resuming(facet: str, how: str, *, later: bool = False) -> Relation:
    """The relation of a value that comes back from before the faults right before a frame.

    With `later` it comes back from before the last faults, if no frame since then has set it.
    """

    def earlier(exchange: Exchange) -> Value:
        before = exchange.previous
        while later and before and not before.step.faulty and not before.sets(facet):
            exchange, before = before, before.previous
        while before and before.step.faulty:
            exchange, before = before, before.previous
        return value_of(facet, exchange.before)

    return Relation(facet, how, RESUMES, earlier)


def _changed(facet: str, change: Callable[[int], int]) -> Predict:
    """Predict the right value, changed."""

    def predict(exchange: Exchange) -> Value:
        value = value_after(facet, exchange)
        return change(value) if isinstance(value, int) else None

    return predict


def _changes(bags: Iterable[Bag]) -> Iterator[tuple[str, Callable[[int], int]]]:
    """What may have been done to the right values of these bags, in words; the simplest first."""
    pairs = [(bag.deviation.expected, bag.deviation.seen) for bag in bags]
    numbers = [(v, s) for v, s in pairs if isinstance(v, int) and isinstance(s, int)]
    width = max((max(abs(v), abs(s)).bit_length() for v, s in numbers), default=0)
    for bit in range(width):
        yield f"lacks bit {bit}", lambda v, b=bit: _sized(v, abs(v) & ~(1 << b))  # type: ignore[misc]
        yield f"has bit {bit}", lambda v, b=bit: _sized(v, abs(v) | 1 << b)  # type: ignore[misc]
    yield "has its bits in the opposite order", lambda v: _sized(v, _mirrored(abs(v), width))
    for most, _ in Counter(abs(s) for _, s in numbers).most_common(2):
        yield f"is {most} at most", lambda v, n=most: max(-n, min(v, n))  # type: ignore[misc]
    yield "has the other sign", lambda v: -v
    for bits in (8, 16):
        half = 1 << bits - 1
        yield f"is that of a signed number of {bits} bits", lambda v, h=half: (v + h) % (2 * h) - h  # type: ignore[misc]
    for offset, _ in Counter(s - v for v, s in numbers).most_common(3):
        yield f"is off by {offset:+d}", lambda v, k=offset: v + k  # type: ignore[misc]
    for total, _ in Counter(s + v for v, s in numbers).most_common(2):
        yield f"is {total} minus the value", lambda v, n=total: n - v  # type: ignore[misc]
    for mask, _ in Counter(abs(v) ^ abs(s) for v, s in numbers).most_common(2):
        turned = ", ".join(str(n) for n in range(width) if mask >> n & 1)
        yield f"has bit {turned} inverted", lambda v, m=mask: _sized(v, abs(v) ^ m)  # type: ignore[misc]
    yield "is half", lambda v: int(v / 2)
    yield "is doubled", lambda v: 2 * v


def _moving_as(motion: Value) -> Predict:
    """Predict a motion wherever the speed lets one be seen."""

    def predict(exchange: Exchange) -> Value:
        car = exchange.after.state.wheels
        if car.speed in exchange.after.unknown:
            return None
        return motion if car.drive(exchange.after.state).speed else car.still

    return predict


def _mirrored(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


def _sized(value: int, size: int) -> int:
    return -size if value < 0 else size
