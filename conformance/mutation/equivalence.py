"""Searches for inputs at which a faulty device differs from the reference, or proves that none do.

The search runs both devices side by side, breadth first over their joint states, so the first
difference has the shortest sequence of inputs. If every joint state was visited without one, the
two are equivalent for this alphabet of inputs. If there are too many states, random sequences are
tried instead; they can show a difference but prove nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import msgspec

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.search_inputs import Symbol, alphabet, hints
from bilprov.spec.protocol import Protocol

MOST = 250_000  # inputs tried by default
WALK = 20_000  # inputs in random sequences, if there are too many states
_QUICK = 8000  # inputs in the random sequences that a search for a drawn fault begins with
_LONG = 100_000  # inputs in the long ones after them
_STRIDE = 400  # inputs in a random sequence, from power-on to power-off
_SHORTENING = 50_000  # inputs sent at most to shorten a sequence
_IDLE = 400 * MS  # how long to wait for what a device does without an input
_TOLD = 8  # inputs of a sequence that are named in words
_BYTES = tuple(bytes([value]) for value in range(256))
_ALIKE = 250 * MS  # longer pauses count as equal


class Search(msgspec.Struct, frozen=True):
    """Result of an equivalence search.

    `shown` are the inputs, in words, of a sequence that shows the fault (empty if none was found),
    `difference` is what differs after it. `closed` is true if the search visited all joint states.
    `states` is the number of states seen, `symbols` the number of inputs tried in each, `depth`
    the longest number of inputs in a row.
    """

    shown: tuple[str, ...]
    difference: str
    closed: bool
    states: int
    symbols: int
    depth: int

    @property
    def equivalent(self) -> bool:
        """Whether no sequence of these inputs shows the fault."""
        return self.closed and not self.shown

    def __str__(self) -> str:
        space = f"{self.states:,} joint states x {self.symbols} inputs"
        if len(self.shown) > _TOLD:
            last = ", ".join(self.shown[-_TOLD:])
            return f"shows after {len(self.shown):,} inputs, last {last}: {self.difference}"
        if self.shown:
            return f"shows after {', '.join(self.shown)}: {self.difference}"
        if self.closed:
            return f"equivalent to the reference: {space}, no difference, none left to visit"
        return f"not shown by any {self.depth} inputs in a row ({space})"


class _Pair(NamedTuple):
    """Both devices at the time `now` (ns), and the inputs (in words) that they have received."""

    reference: Simulator
    faulty: Simulator
    now: int
    words: tuple[str, ...]

    def clone(self) -> _Pair:
        return _Pair(self.reference.clone(), self.faulty.clone(), self.now, self.words)

    def key(self) -> Hashable:
        """Return the joint state key: pairs with equal keys behave alike from here on."""
        return tuple(one.state_key(self.now, _ALIKE) for one in (self.reference, self.faulty))


def search(protocol: Protocol, fault: Fault, most: int = MOST) -> Search:
    """Search until the fault shows or no joint state is left; after `most` inputs, at random.

    The random sequences have `most` inputs in all, and not more than `WALK`.
    """
    inputs = alphabet(protocol, hints(protocol, fault))
    found = _search(protocol, fault, inputs, most)
    if found.shown or found.closed:
        return found
    walk = random_search(protocol, fault, inputs, min(WALK, most), min(_STRIDE, most))
    words, different = try_sequence(protocol, fault, walk)
    return msgspec.structs.replace(found, shown=words, difference=different)


def difference(protocol: Protocol, fault: Fault, most: int = MOST) -> Search:
    """Search at random, in short and in long sequences, and then as `search` does.

    For drawn faults: most of them show at random in a moment, and those with a long rhythm show in
    a long sequence alone. Each of these parts has at most `most` inputs.
    """
    inputs = alphabet(protocol, hints(protocol, fault))
    for steps, stride in ((_QUICK, _QUICK // 4), (_LONG, _LONG // 5)):
        shown = random_search(protocol, fault, inputs, min(steps, most), min(stride, most))
        if shown:
            words, different = try_sequence(protocol, fault, shown)
            return Search(words, different, False, 0, len(inputs), len(words))
    return search(protocol, fault, most)


def random_search(
    protocol: Protocol,
    fault: Fault,
    inputs: Sequence[Symbol],
    steps: int = WALK,
    stride: int = _STRIDE,
) -> list[Symbol]:
    """Try random sequences of `steps` inputs in all; return one that shows the fault, or [].

    Each has `stride` inputs, about every fourth of them one at which the fault hints. The sequence
    is shortened: it ends with the input at which the fault shows, and inputs before that which are
    not needed are left out.
    """
    draw = Draw(1)
    valid = [symbol for symbol in inputs if symbol.valid]
    usual = set(alphabet(protocol))
    hinted = [symbol for symbol in inputs if symbol not in usual]
    kinds = (valid, valid, inputs, *([hinted] if hinted else []))
    for _ in range(max(1, steps // stride)):
        sequence = [draw.pick(draw.pick(kinds)) for _ in range(stride)]
        shown, _ = try_sequence(protocol, fault, sequence)
        if shown:
            return _shortened(protocol, fault, sequence[: len(shown)])
    return []


def _shortened(protocol: Protocol, fault: Fault, sequence: list[Symbol]) -> list[Symbol]:
    """Shorten a sequence that shows the fault: leave out halves, then quarters, then inputs.

    A count of many inputs cannot be shortened: after `_SHORTENING` inputs it is left as it is.
    """
    size, sent = len(sequence) // 2, 0
    while size and sent < _SHORTENING:
        start = 0
        while start < len(sequence) and sent < _SHORTENING:
            sent += len(sequence)
            fewer = sequence[:start] + sequence[start + size :]
            shown, _ = try_sequence(protocol, fault, fewer)
            if shown:
                sequence = fewer[: len(shown)]
            else:
                start += size
        size //= 2
    return sequence


def _started(protocol: Protocol, faulty: Simulator) -> tuple[_Pair, str]:
    """Return both devices 10 ms after power-on, and what differed until then."""
    pair = _Pair(Simulator(protocol), faulty, 0, ())
    return pair._replace(now=10 * MS), _watch(pair, 10 * MS)


def try_sequence(
    protocol: Protocol, fault: Fault, sequence: Sequence[Symbol]
) -> tuple[tuple[str, ...], str]:
    """Send inputs to both devices until they differ; return their words and what differs."""
    pair, _ = _started(protocol, Simulator(protocol, fault))
    for index, symbol in enumerate(sequence, 1):
        pair, different = _send(pair._replace(words=()), symbol)
        if not different:
            different = _watch(pair.clone(), pair.now + _IDLE)
        if different:
            return tuple(sent.words for sent in sequence[:index]), different
    return (), ""


def _search(protocol: Protocol, fault: Fault, inputs: tuple[Symbol, ...], most: int) -> Search:
    start, different = _started(protocol, Simulator(protocol, fault))
    seen = {start.key()}
    queue = deque([start])
    tried = depth = 0
    while queue and not different:
        pair = queue.popleft()
        for symbol in inputs:
            tried += 1
            if tried > most:
                return Search((), "", False, len(seen), len(inputs), depth)
            after, different = _send(pair.clone(), symbol)
            if not different:
                key = after.key()
                if key in seen:
                    continue
                seen.add(key)
                queue.append(after)
                # What the devices do without an input is compared once in each state.
                different = _watch(after.clone(), after.now + _IDLE)
            if different:
                return Search(after.words, different, False, len(seen), len(inputs), depth + 1)
        depth = len(pair.words)
    return Search((), different, not different, len(seen), len(inputs), depth)


def _send(pair: _Pair, symbol: Symbol) -> tuple[_Pair, str]:
    """Send an input to both devices; return the pair after it and what differed ("" if nothing)."""
    reference, faulty, now, words = pair
    words = (*words, symbol.words)
    for pause, byte in symbol.bytes:
        now += pause
        different = _watch(pair, now)
        if not different:
            data = _BYTES[byte]
            reference.receive(data, now)
            faulty.receive(data, now)
            different = _compare(pair, now)
        if different:
            return _Pair(reference, faulty, now, words), different
    now += symbol.after
    different = _watch(pair, now) if symbol.after else ""
    return _Pair(reference, faulty, now, words), different


def _watch(pair: _Pair, until: int) -> str:
    """Let time pass until `until` (ns); return what differed meanwhile, "" if nothing."""
    reference, faulty = pair.reference, pair.faulty
    while True:
        due, other = reference.deadline(), faulty.deadline()
        if due is None or (other is not None and other < due):
            due = other
        if due is None:
            return ""
        different = _compare(pair, min(due, until))
        if different or due >= until:
            return different


def _compare(pair: _Pair, now: int) -> str:
    said, other = pair.reference.advance(now), pair.faulty.advance(now)
    if said != other:
        return f"answers {other.hex(' ') or 'nothing'} where {said.hex(' ') or 'nothing'} is due"
    state, have = pair.reference.state, pair.faulty.state
    if pair.faulty.fault.show is None and (state is have or state == have):
        return ""
    look, seen = pair.reference.look(now), pair.faulty.look(now)
    if look == seen:
        return ""
    facet = next(n for n in look.__struct_fields__ if getattr(look, n) != getattr(seen, n))
    return f"{facet} is {getattr(seen, facet)} where {getattr(look, facet)} is due"
