"""Searches for inputs at which a faulty device differs from the reference, or proves that none do.

The search runs both devices side by side, breadth first over their joint states, so the first
difference has the shortest sequence of inputs. If every joint state was visited without one, the
two are equivalent for this alphabet of inputs. If there are too many states, random sequences are
tried instead; they can show a difference but prove nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import msgspec

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.steps import TOO_MANY, FrameClass, one_of_each
from bilprov.conformance.dut.fault import Event, Fault
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.random_faults import Draw
from bilprov.conformance.mutation.triggers import Trigger
from bilprov.spec.codec import all_data, bad_data, judge, raw_frame
from bilprov.spec.protocol import InstructionSpec, Protocol

_QUIET = 170 * MS
_SPLIT = 3 * MS
_RUNS = (16, 250)  # how many stops, or faults, are sent in a row
_REPEATED = (FrameClass.UNUSED_ID, TOO_MANY, FrameClass.BAD_DATA)
_VALUES = ("value", "speed", "steering", "led")
_EXAMPLES = 3  # frames of a trigger that are inputs of their own
_HEADERS_AND_BYTES = ("id", "length", "size", "excess", "first-byte", "second-byte", "last-byte")
_BURST = 70  # bytes without a pause: more than a small buffer holds


class Symbol(NamedTuple):
    """One input of the search.

    `words` describe it, `bytes` are a (pause before it in ns, value) for each byte, `after` is the
    time (ns) to wait afterwards. `valid` is true for a frame without fault.
    """

    words: str
    bytes: tuple[tuple[int, int], ...]
    after: int = 0
    valid: bool = False


def alphabet(protocol: Protocol, given: Sequence[int | bytes] = ()) -> tuple[Symbol, ...]:
    """Return every input that a search tries; `given` are further data values, and frames.

    A frame with fewer data bytes than its header announces is cut short.
    """
    values = [hint for hint in given if isinstance(hint, int)]
    frames = [hint for hint in given if isinstance(hint, bytes)]
    whole = [frame for frame in frames if len(frame) > protocol.lengths[frame[0]]]
    byte = line_settings(protocol).byte_time
    waited, idle = 3 * byte, _QUIET
    valid = [frame for spec in protocol.instructions for frame in _valid(spec, protocol, values)]
    few = list(_faulty(protocol, values, every=False))
    found: list[Symbol] = []
    for frame in (*valid, *whole, *_faulty(protocol, values, every=True)):
        found.append(_symbol(protocol, frame, "", waited, byte))
    for frame in (*valid, *whole, *few):
        found.append(_symbol(protocol, frame, "sent ahead", byte, byte))
        found.append(_symbol(protocol, frame, "after 170 ms", idle, byte))
        if len(frame) > 1:
            found.append(_symbol(protocol, frame, "split", waited, _SPLIT))
    timeout = int(protocol.timing.truncation_timeout * MS)
    for cut in (*_cut(protocol), *(frame for frame in frames if frame not in whole)):
        symbol = _symbol(protocol, cut, "cut short", waited, byte)
        found.append(symbol._replace(after=timeout + timeout // 4))
    repeated = [step.frame for kind, step in one_of_each(protocol).items() if kind in _REPEATED]
    for frame in (bytes([protocol.pad_byte]), *repeated):
        for count in _RUNS:
            run = _symbol(protocol, frame, f"{count} times", waited, byte)
            found.append(run._replace(bytes=run.bytes * count))
    burst = _symbol(protocol, bytes([protocol.pad_byte]), f"{_BURST} at once", byte, byte)
    found.append(burst._replace(bytes=burst.bytes * _BURST))
    return tuple(found)


def _cut(protocol: Protocol) -> Iterator[bytes]:
    """Yield frames that end too early, at once or before the last byte: two headers for each ID."""
    for identity in protocol.ids:
        known = protocol.by_id.get(identity)
        for length in sorted({max(1, known.length if known else 1), protocol.data_lengths[-1]}):
            for arrived in {0, length - 1}:
                yield raw_frame(protocol, identity, length, bytes([protocol.pad_byte]) * arrived)


def _symbol(protocol: Protocol, frame: bytes, how: str, first: int, between: int) -> Symbol:
    judgement = judge(protocol, frame)
    name = judgement.describe()
    pauses = (first, *[between] * (len(frame) - 1))
    words = f"{name} [{frame.hex(' ')}]{' ' + how if how else ''}"
    return Symbol(words, tuple(zip(pauses, frame, strict=True)), valid=judgement.valid)


def _valid(spec: InstructionSpec, protocol: Protocol, hints: Sequence[int]) -> Iterator[bytes]:
    """Yield valid frames: the first and last data, one named bit, hints in the first field."""
    data = list(all_data(spec))
    chosen = {data[0]: None, data[-1]: None}
    if spec.fields and spec.fields[0].bits:
        chosen[data[1]] = None
    for part in spec.fields[:1]:
        for hint in hints:
            if part.low <= hint <= part.high:
                values = [part.build(hint), *(other.build(other.low) for other in spec.fields[1:])]
                chosen[b"".join(values)] = None
    for some in chosen:
        yield raw_frame(protocol, spec.id, spec.length, some)


def _faulty(protocol: Protocol, hints: Sequence[int], *, every: bool) -> Iterator[bytes]:
    """Yield complete faulty frames: every header (or up to two for each ID), and bad data."""
    for identity in protocol.ids:
        known = protocol.by_id.get(identity)
        lengths = [n for n in protocol.data_lengths if known is None or n != known.length]
        for length in lengths if every else lengths[:2]:
            yield raw_frame(protocol, identity, length, bytes([protocol.pad_byte]) * length)
        if known and known.fields:
            longer = known.length + 1
            if longer in protocol.data_lengths:
                yield raw_frame(protocol, identity, longer, b"\xff" * longer)
            bad = list(bad_data(known))
            wanted = {1 << bit for bit in range(8)} | set(hints)
            ends = [bad[0], bad[-1]] if bad else []
            chosen = [data for data in bad if data[0] in wanted or data in ends]
            for data in chosen if every else ends[-1:]:
                yield raw_frame(protocol, identity, known.length, data)


def hints(protocol: Protocol, fault: Fault) -> tuple[int | bytes, ...]:
    """Return data values and frames at which a fault shows, from its trigger and its effect."""
    wheels = fault.what.split() if fault.show else []
    values = {int(word) for word in wheels if word.isdigit()}
    acting = fault.trigger
    if not isinstance(acting, Trigger):
        return tuple(values)
    for part in (acting, acting.since, acting.until):
        for term in part.terms if part else ():
            values |= set(term.values) if term.subject in _VALUES else set()
    around = (end for value in sorted(values) for end in (value, value - 1))
    return (*(value for value in around if 0 <= value <= 0xFF), *_examples(protocol, acting))


def _examples(protocol: Protocol, acting: Trigger) -> list[bytes]:
    """Return some frames of a trigger that is about headers or data bytes, cut ones too."""
    frame_terms = acting.about_frame
    if all(term.subject not in _HEADERS_AND_BYTES for term in frame_terms):
        return []
    bytes_ = [t.values[0] for t in frame_terms if t.subject.endswith("-byte")]
    sizes = [t.values[0] for t in frame_terms if t.subject == "size"]
    found = []
    for header, length in enumerate(protocol.lengths):
        for fill, place in product([protocol.pad_byte, *bytes_], (0, 1, length - 1)):
            data = bytearray([protocol.pad_byte] * length)
            if 0 <= place < length:
                data[place] = fill
            for size in sizes or [length + 1]:
                frame = bytes([header, *data])[:size]
                kind = "instruction" if size > length else "truncated"
                event = Event(protocol, judge(protocol, frame), protocol.power_on, 0, 0, kind, 0)
                if all(term.holds(term.of(event)) for term in frame_terms):
                    found.append(frame)
    return list(dict.fromkeys(found))[:_EXAMPLES]


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
