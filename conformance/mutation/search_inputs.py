"""Inputs of the equivalence search: each kind of frame, representative data, each delivery."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS
from bilprov.conformance.cases.steps import TOO_MANY, FrameClass, one_of_each
from bilprov.conformance.dut.fault import Event, Fault
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
