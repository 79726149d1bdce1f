"""Can a fault show at all? A search through all that reference and faulty device do side by side.

Breadth first over the joint states: what is found first is the shortest way to see the fault. If
no joint state is left and none differed, the two are equivalent for that alphabet of inputs. Where
there are too many states random walks go on; they show, and prove nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import msgspec

from conformance.dut.fault import MS, Fault
from conformance.dut.fault_reads import Reads
from conformance.dut.simulator import Simulator
from conformance.mutation.random_faults import Draw
from conformance.mutation.search_inputs import Symbol, alphabet
from spec.protocol import Protocol

MOST = 250_000  # inputs that are tried, unless told otherwise
WALK = 20_000  # inputs of random walks, where the space is too large
_STRIDE = 400  # inputs from power-on to power-off
_IDLE = 400 * MS  # a line is watched for so long in order to see what comes by itself
_BYTES = tuple(bytes([value]) for value in range(256))
_ALIKE = 250 * MS  # pauses above this are alike


class Search(msgspec.Struct, frozen=True):
    """What a search found.

    `shown` are the inputs, in words, of the shortest sequence that shows the fault, and
    `difference` what it then shows; without one `closed` says whether the search went through all
    joint states. `states` and `depth` are how many states and how many inputs in a row it saw,
    `symbols` how many inputs it tried in each.
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
        if self.shown:
            return f"shows after {', '.join(self.shown)}: {self.difference}"
        if self.closed:
            return f"equivalent to the reference: {space}, no difference, none left to visit"
        return f"not shown by any {self.depth} inputs in a row ({space})"


class _Pair(NamedTuple):
    """Both devices at a time (ns), and how they came there."""

    reference: Simulator
    faulty: Simulator
    now: int
    words: tuple[str, ...]

    def twin(self) -> _Pair:
        return _Pair(self.reference.twin(), self.faulty.twin(), self.now, self.words)

    def key(self, reads: Reads) -> Hashable:
        """Pairs with equal keys do the same from here on."""
        return (
            self.reference.snapshot(self.now, _ALIKE, Reads()),
            self.faulty.snapshot(self.now, _ALIKE, reads),
        )


def search(protocol: Protocol, fault: Fault, most: int = MOST) -> Search:
    """Search until the fault shows, no state is left, or `most` inputs were tried."""
    inputs = alphabet(protocol, fault.hints)
    reads = Reads()
    while True:
        known = len(reads)
        found = _search(protocol, fault, inputs, reads, most)
        if not found.shown and not found.closed:
            return _wander(protocol, fault, inputs, found)
        # A part of the past that it had not looked at before: states taken as one were two.
        if found.shown or len(reads) == known:
            return found


def _wander(protocol: Protocol, fault: Fault, inputs: tuple[Symbol, ...], found: Search) -> Search:
    """Where the space is too large, walk in it at random; what shows is then made shorter."""
    walk = walk_to_difference(protocol, fault, inputs)
    if not walk:
        return found
    words, different = _walk(protocol, fault, walk)
    return msgspec.structs.replace(found, shown=words, difference=different)


def walk_to_difference(
    protocol: Protocol, fault: Fault, inputs: Sequence[Symbol], steps: int = WALK
) -> list[Symbol]:
    """Inputs that show the fault, out of walks of `steps` inputs in all; none if none did.

    The last input is the one at which it shows; whatever can be left out before it is left out.
    """
    draw = Draw(1)
    valid = [symbol for symbol in inputs if symbol.valid]
    for _ in range(max(1, steps // _STRIDE)):
        walk = [draw.pick(valid if draw.below(3) else inputs) for _ in range(_STRIDE)]
        shown, _ = _walk(protocol, fault, walk)
        if shown:
            return _shortened(protocol, fault, walk[: len(shown)])
    return []


def _shortened(protocol: Protocol, fault: Fault, walk: list[Symbol]) -> list[Symbol]:
    """As few of the inputs as still show it: halves are left out, then quarters, then each."""
    size = len(walk) // 2
    while size:
        start = 0
        while start < len(walk):
            fewer = walk[:start] + walk[start + size :]
            shown, _ = _walk(protocol, fault, fewer)
            if shown:
                walk = fewer[: len(shown)]
            else:
                start += size
        size //= 2
    return walk


def _walk(protocol: Protocol, fault: Fault, walk: Sequence[Symbol]) -> tuple[tuple[str, ...], str]:
    """Send the inputs to both; the words of those until they differ, and what differs."""
    pair = _Pair(Simulator(protocol), Simulator(protocol, fault), 0, ())
    different = _watch(pair, 10 * MS)
    pair = pair._replace(now=10 * MS)
    for symbol in walk:
        pair, different = _send(pair, symbol)
        if not different:
            different = _watch(pair.twin(), pair.now + _IDLE)
        if different:
            return pair.words, different
    return (), ""


def _search(
    protocol: Protocol, fault: Fault, inputs: tuple[Symbol, ...], reads: Reads, most: int
) -> Search:
    faulty = Simulator(protocol, fault)
    faulty.reads = reads
    start = _Pair(Simulator(protocol), faulty, 0, ())
    different = _watch(start, 10 * MS)
    start = start._replace(now=10 * MS)
    seen = {start.key(reads)}
    queue = deque([start])
    tried = depth = 0
    while queue and not different:
        pair = queue.popleft()
        for symbol in inputs:
            tried += 1
            if tried > most:
                return Search((), "", False, len(seen), len(inputs), depth)
            after, different = _send(pair.twin(), symbol)
            if not different:
                key = after.key(reads)
                if key in seen:
                    continue
                seen.add(key)
                queue.append(after)
                # What comes by itself is looked for once in each state.
                different = _watch(after.twin(), after.now + _IDLE)
            if different:
                return Search(after.words, different, False, len(seen), len(inputs), depth + 1)
        depth = len(pair.words)
    return Search((), different, not different, len(seen), len(inputs), depth)


def _send(pair: _Pair, symbol: Symbol) -> tuple[_Pair, str]:
    """Send an input to both; returns the pair after it, and what differed, "" if nothing."""
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
    """Let time pass; what differed when either of them acted by itself, "" if nothing."""
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
