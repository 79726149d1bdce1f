"""Puts captures together by wall-clock time: other directions, other hours, one recording.

A direction may be in several of them, but not at the same time. Where a capture begins after the
first one, a `gap` says so on its taps: what came before was not recorded there. If it is a part
that was cut off the one before it, there is none, and decoding goes on as in the whole.

Decoded by the new times and in the new order, checkpoints are made anew. Those with which a part
begins that was cut out are left out: after a gap decoding begins anew.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from math import ceil, nan
from typing import Literal, NamedTuple, TypeAlias

from msgspec.structs import replace

from bilprov.analyzer.decode.session import BOTH, SKEW, SessionSettings
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.edit.cut import CUT_THROUGH, Copy, Timed, batched, said_of, timed
from bilprov.analyzer.replay.capture_decoding import capture_settings
from bilprov.analyzer.replay.recorder import decoding_metadata, grammar_metadata
from bilprov.analyzer.version import kit_version
from bilprov.captures import schemas, topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Direction, Line, Recorded
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol

_OF_ONE = {topics.START_KEY, topics.HISTORY, topics.CUT_START, topics.CUT_END, topics.PART}
Tap: TypeAlias = "Direction | Literal['']"


class _Source(NamedTuple):
    """A capture that is put together with others, and when it was recorded (wall clock, ns).

    It begins there, or the part does that was cut out of it.
    """

    capture: Capture
    settings: SessionSettings
    first: int
    last: int

    @property
    def tap(self) -> Tap:
        """The one direction that it hears, "" for both."""
        heard = self.settings["heard"]
        return "" if heard >= BOTH else next(iter(heard))


class Joined:
    """Captures that go together. Raises CaptureError, in one sentence, if they do not.

    `start` is the wall clock at the time 0 of the new one, in ns.
    """

    def __init__(self, protocol: Protocol, captures: Sequence[Capture]) -> None:
        self.sources: list[_Source] = []
        for capture in captures:
            first = capture.start + (capture.number(topics.CUT_START) or 0)
            settings, last = capture_settings(capture, protocol), max(capture.contents.last, first)
            self.sources.append(_Source(capture, settings, first, last))
        self.sources.sort(key=lambda source: (source.first, -source.last))
        self.start = min(capture.start for capture in captures)
        _require_apart(self.sources)
        self._protocol = protocol
        self.settings = _settings(self.sources)

    def metadata(self) -> dict[str, str]:
        """The metadata of all: what they agree on, and the rest with the number of its capture."""
        abouts = [source.capture.contents.metadata for source in self.sources]
        grammar = grammar_metadata(self._protocol)
        about: dict[str, str] = dict(grammar)
        for key in dict.fromkeys(key for one in abouts for key in one):
            if key in _OF_ONE or key in grammar:
                continue
            stated = {number: one[key] for number, one in enumerate(abouts, 1) if key in one}
            if len({*stated.values()}) == 1:
                _, about[key] = stated.popitem()
            else:
                about |= {f"{number}.{key}": text for number, text in stated.items()}
        about |= decoding_metadata(self.settings)
        names = [said_of(source.capture.path) for source in self.sources]
        about |= {f"{number}.file": name for number, name in enumerate(names, 1)}
        done = f"join {' '.join(names)} (bilprov {kit_version()})"
        before = dict.fromkeys(one[topics.HISTORY] for one in abouts if one.get(topics.HISTORY))
        about[topics.HISTORY] = "; ".join([*before, done])
        return about


def write_joined(joined: Joined, copy: Copy) -> None:
    """Write the captures as one. Raises CaptureError as `Capture.events` and the writer do."""
    protocol = copy.protocol
    decoder = StreamDecoder(protocol, **joined.settings)
    streams = [_values(joined, place, protocol) for place in range(len(joined.sources))]
    merged = (one.value for one in heapq.merge(*streams, key=lambda one: one.now))
    for batch in batched(timed(merged, 0)):
        copy.take(batch, decoder)


def _values(joined: Joined, place: int, protocol: Protocol) -> Iterator[Timed]:
    """Yield what a capture holds, at the times of the new one, and where it begins."""
    source = joined.sources[place]
    by = source.capture.start - joined.start
    if place and not _continues(joined.sources[place - 1], source):
        said = f"{said_of(source.capture.path)} begins here"
        begin = source.first - joined.start
        yield Timed(begin, Line(begin, "gap", source.tap, said))
    goes_on = any(_continues(source, after) for after in joined.sources[place + 1 : place + 2])
    for one in timed(source.capture.recorded(looks=schemas.look_class(protocol.state_type)), 0):
        cut_through = isinstance(one.value, Line) and one.value.detail == CUT_THROUGH
        if not (_restarts(one.value) or (goes_on and cut_through)):
            yield Timed(one.now + by, _moved(one.value, by, source.tap))


def _continues(before: _Source, after: _Source) -> bool:
    """Whether a part was cut off, or begun, right where the one before it ends."""
    one, other = before.capture, after.capture
    cut = one.metadata.get(topics.CUT_END)
    cut_off = cut is not None and cut == other.metadata.get(topics.CUT_START)
    next_part = (one.number(topics.PART) or nan) + 1 == other.number(topics.PART)
    return one.start == other.start and (cut_off or next_part)


def _moved(value: Recorded, by: int, tap: Tap) -> Recorded:
    """A value `by` ns later. Where bytes are left out, a gap on `tap`."""
    if isinstance(value, schemas.Resumption):
        return Line(value.t + by, "gap", tap, value.detail)
    if isinstance(value, schemas.Asked) and value.begun is not None:
        return replace(value, t=value.t + by, begun=value.begun + by)
    return replace(value, t=value.t + by)


def _restarts(value: Recorded) -> bool:
    """Whether a value only tells how decoding goes on, which is by the times of one capture."""
    return isinstance(value, schemas.Checkpoint) or (
        isinstance(value, schemas.Resumption) and value.silent
    )


def _settings(sources: Sequence[_Source]) -> SessionSettings:
    """How the captures are decoded together."""
    heard = frozenset(side for source in sources for side in source.settings["heard"])
    skews = [source.settings["skew"] for source in sources]
    if not any(source.tap == "" for source in sources) and heard >= BOTH:
        skews.append(SKEW)  # two recorders, each with a clock of its own
    first = next((s for s in sources if "host" in s.settings["heard"]), sources[0])
    return {
        "timeout": max(source.settings["timeout"] or 0 for source in sources),
        "skew": max(skews),
        "heard": heard,
        "attached": first.settings["attached"],
    }


def _require_apart(sources: Sequence[_Source]) -> None:
    """Raise CaptureError if two captures, by their beginning, hold a direction at one time."""
    for place, early in enumerate(sources):
        for late in sources[place + 1 :]:
            both = early.settings["heard"] & late.settings["heard"]
            if both and late.first < early.last and early.first < late.last:
                name, other = printable(late.capture.path), printable(early.capture.path)
                sides = " and ".join(sorted(both, reverse=True))
                start = ceil((early.last + 1 - late.capture.start) / 1000) / 1_000_000
                advice = (
                    f"cut the second first, bilprov capture cut {name} NEW.mcap --start {start:f}"
                )
                if late.last <= early.last:
                    advice = f"leave out {name}"
                raise CaptureError(
                    f"{other} and {name} both hold the {sides} at the same time, and every byte "
                    f"would be there twice: {advice}"
                )
