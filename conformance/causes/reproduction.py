"""The shortest line of frames that shows a cause on a device that was just brought to rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

from bilprov.analyzer.client.operations import (
    Procedure,
    drive,
    followed,
    listen,
    observe,
    power_cycle,
    send,
)
from bilprov.analyzer.client.rest import home_once
from bilprov.captures.schemas import MS
from bilprov.conformance.causes.exchanges import Deviation, Exchange, Exchanges, Timing, repeats
from bilprov.conformance.causes.features import Feature, matches
from bilprov.conformance.causes.relations import Effect
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Device, VirtualLink
from bilprov.conformance.oracle.state_model import Model
from bilprov.spec.by_effect import frames_to

if TYPE_CHECKING:
    from bilprov.conformance.causes.causes import Cause

_FRAMES = 2
"""Frames under test of each kind from which the shortest line is chosen."""
_TRIES = 300
"""Lines that are tried on the simulator at most."""
_LONGEST = 160
"""Frames of a line at most."""
_COUNTED = 400
"""Frames that only count, or came before it in the run, at most."""
_SETTLED = 20 * MS
"""How long (ns) a device has for a change after its last answer, before it is looked at again."""
_SILENT = 3
"""Frames without an answer, one after the other, until each next one is waited for only shortly."""
_DELIVERY = {"ahead", "in one go", "sent ahead", "split", "pause", "gap"}
"""Features that only frames sent by their times, and not by their answers, show..."""
_USUAL = {"sent in one piece", "not sent ahead"}
"""...but for these values of theirs."""


class Chunk(NamedTuple):
    """Bytes that are sent in one go, `pause` ns after those before."""

    pause: int
    data: bytes


class Line(NamedTuple):
    """Frames to send. With `together` their answers are not waited for.

    `unhomed` is for a device that was just switched on: it is not homed first. Where it is one
    line sent again and again, the device is looked at after each `period` of frames, too.
    """

    chunks: tuple[Chunk, ...]
    frames: int
    together: bool = False
    unhomed: bool = False
    period: int = 0

    def without(self, start: int, size: int) -> Line:
        """This line without so many frames from that one on, its answers awaited."""
        chunks = self.chunks[:start] + self.chunks[start + size :]
        return self._replace(chunks=chunks, frames=self.frames - size)

    def without_last(self, number: int) -> Line:
        """This line without its last frames; one that is sent together stays as it is."""
        if self.together:
            return self
        return self._replace(chunks=self.chunks[:-number], frames=self.frames - number)

    def times(self, number: int) -> Line:
        """This line so often."""
        frames, period = self.frames * number, self.frames
        return self._replace(chunks=self.chunks * number, frames=frames, period=period)

    def behind(self, frame: bytes, number: int) -> Line:
        """This line behind so many of these frames."""
        counting = (Chunk(self.chunks[0].pause, frame),) * number
        return self._replace(chunks=(*counting, *self.chunks), frames=self.frames + number)

    @property
    def words(self) -> tuple[str, ...]:
        """The arguments of `bilprov send PORT`."""
        words = ["--unhomed"] * self.unhomed + ["--together"] * self.together
        for number, chunk in enumerate(self.chunks):
            words += [f"pause={-(-chunk.pause // MS)}"] if number and chunk.pause else []
            words.append(chunk.data.hex(" "))
        return tuple(words)


def shown_by(line: Line, timing: Timing, watched: int = 0, *, looks: bool) -> Procedure[None]:
    """Send a line to a device at rest, hear its answers, and look at it if `looks`.

    The last look comes `watched` ns after the last answer: what changes by itself needs time.
    """
    patience, silent = timing.longest + timing.timeout, 0
    for number, (pause, data) in enumerate(line.chunks, 1):
        if pause:
            yield from listen(None, pause)
        yield from send(data)
        if line.together:
            continue
        heard = yield from listen(1, patience if silent < _SILENT else timing.timeout)
        silent = 0 if heard.answers else silent + 1
        left = len(line.chunks) - number
        if looks and left and line.period and left % line.period == 0:
            yield from listen(None, _SETTLED)
            yield from observe()
    if line.together:
        yield from listen(line.frames, patience)
    if looks:
        yield from observe()
    yield from listen(None, max(_SETTLED, watched))
    if looks:
        yield from observe()


def exchanged(
    line: Line, timing: Timing, model: Model, device: Device, watched: int = 0
) -> Exchanges:
    """Home a device object, or switch it on, send it a line and look at it as `shown_by` does."""
    trace = Trace()

    def attempt() -> Procedure[None]:
        yield from power_cycle() if line.unhomed else home_once(model.protocol)
        trace.begin("")
        yield from shown_by(line, timing, watched, looks=True)

    drive(followed(attempt(), trace), VirtualLink(device, timing.byte_time))
    return Exchanges(model, trace.events, timing)


class Finder:
    """Finds the line for a cause; a conforming simulator shows what each line would bring about."""

    def __init__(self, model: Model, timing: Timing) -> None:
        self._model, self._timing = model, timing

    def lines(self, cause: Cause) -> list[Line]:
        """Return lines to try, in this order, until one shows the cause.

        The first is the shortest at whose last frame the cause would show by all that is known of
        it, but for what it counts. The last are the frames of the case in which it showed, and all
        before it. Where some of the case were sent ahead, they are sent by the times of the run.
        """
        clear = [e for e in cause.exchanges if not e.before.unknown and cause.foresees(e)]
        simplest = _simplest(clear or cause.exchanges)[0]
        shortest = self._shortest(cause)
        chain = _chain(simplest)
        case = [exchange for exchange in chain if exchange.case == simplest.case]
        ahead = any(exchange.ahead for exchange in case)
        met = (_line(one, (), self._timing, together=ahead) for one in (case, chain))
        return list(dict.fromkeys((shortest, *self._counted(cause, shortest, simplest), *met)))

    def _counted(self, cause: Cause, line: Line, last: Exchange) -> Iterator[Line]:
        """As many frames before it as the cause counts; then it is also sent again and again.

        Where it shows from some number on, it is not certain what the device counts: it may be all
        frames, or how often this one came so far. Nor is it that a cause counts which does not.
        """
        counted = [literal for literal in cause.rule if literal.feature.counts]
        periods = [literal.period for literal in counted if literal.operator == "every"]
        often = line.times(max(1, min([_LONGEST // line.frames, *periods])))
        for longer in (line, often) if counted else (often,):
            for literal in counted:
                missing, sent = last.history.frames, self._last(longer)
                if literal.operator == "every" and sent:
                    missing = literal.missing(sent)
                counting = _counting(literal.feature, last)
                longer = longer.behind(counting, min(missing, _COUNTED))
            yield longer

    def _shortest(self, cause: Cause) -> Line:
        """The shortest line at whose last frame the cause would show, but for what it counts.

        Where there is none (the cause depends on more than a line can hold), it is the shortest of
        those that end in a frame of the cause.
        """
        lines = sorted(self._lines(cause), key=lambda e: (e.unhomed, e.frames, len(e.chunks)))
        effects = tuple(cause.effects)
        worst = tuple(effect for effect in effects if effect.keeps_moving) or effects[:1]
        partly: Line | None = None
        for line in lines[:_TRIES]:
            last = self._last(line)
            if last and _shown(cause, effects, last):
                return self._shortened(cause, effects, line)
            if last and partly is None and _shown(cause, worst, last):
                partly = line
        return lines[0] if partly is None else self._shortened(cause, worst, partly)

    def _lines(self, cause: Cause) -> Iterator[Line]:
        delivery = [e for e in cause.rule if e.feature.name in _DELIVERY and e.value not in _USUAL]
        moving = [e for e in cause.exchanges if cause.moves_on and e.before.state.moving]
        for last in _simplest(moving or cause.exchanges):
            for chain in _endings(last):
                before = chain[0].before
                way = () if before.unknown else frames_to(self._model.protocol, before.state)
                for first in dict.fromkeys(((), way)):
                    yield _line(chain, first, self._timing, together=bool(delivery))

    def _last(self, line: Line) -> Exchange | None:
        """The last exchange of a line on the simulator."""
        sent = exchanged(line, self._timing, self._model, Simulator(self._model.protocol)).all
        return sent[-1] if sent else None

    def _shortened(self, cause: Cause, shown: Sequence[Effect], line: Line) -> Line:
        """The line without the frames that it does not need on the simulator."""
        lines = [line]
        for shorter in shorter_lines(lines):
            last = self._last(shorter)
            if last and _shown(cause, shown, last):
                lines.append(shorter)
        return lines[-1]


def shorter_lines(lines: list[Line]) -> Iterator[Line]:
    """Yield lines that lack some frames of the last of these, until none is left to try.

    One that serves is to become the last of them. The last frame stays, and nothing is taken from a
    line that is sent together.
    """
    size = 0 if lines[-1].together else len(lines[-1].chunks) // 2
    while size:
        for start in range(0, len(lines[-1].chunks) - size, size):
            line = lines[-1]
            yield line.without(start, size)
            if lines[-1] is not line:
                break
        else:
            size //= 2


class Shown(NamedTuple):
    """A line up to the frame at which it has shown a cause, and the deviation there."""

    line: Line
    deviation: Deviation


def shown_in(
    cause: Cause, line: Line, exchanges: Exchanges, known: Deviation | None = None
) -> Shown | None:
    """Return how a line has shown the cause, None where it has not.

    That is its last frame, or one before at which the cause would show. Where another line has
    shown the `known` deviation, this one is to show one of the same facet.
    """
    if not exchanges.all:
        return None
    last = exchanges.all[-1]
    for bag in exchanges.bags:
        facet = bag.deviation.facet
        if known and known.facet != facet:
            continue
        effects = [effect for effect in cause.effects if effect.relation.facet == facet]
        explaining = [effect for effect in effects if effect.relation.explains(bag)]
        for effect, exchange in product(explaining, reversed(bag.exchanges)):
            behind = last.history.frames - exchange.history.frames
            if not behind:
                return Shown(line, bag.deviation)
            if behind < line.frames and _shown(cause, [effect], exchange):
                return Shown(line.without_last(behind), bag.deviation)
    return None


def _shown(cause: Cause, effects: Sequence[Effect], exchange: Exchange) -> bool:
    """Whether these effects of a cause would all show at an exchange, but for what it counts.

    That a device moves on shows where it moved.
    """
    if cause.moves_on and not exchange.before.state.moving:
        return False
    differ = all(effect.relation.differs(exchange) for effect in effects)
    rule = tuple(literal for literal in cause.rule if not literal.feature.counts)
    return differ and matches(rule, exchange)


def _counting(feature: Feature, exchange: Exchange) -> bytes:
    """The last frame before an exchange that a feature counts."""
    while exchange.previous and feature.of(exchange) == feature.of(exchange.previous):
        exchange = exchange.previous
    return (exchange.previous or exchange).step.frame


def _simplest(exchanges: Sequence[Exchange]) -> list[Exchange]:
    """The exchanges of each kind that have the shortest frames and came soonest after power-on."""
    by_kind: dict[str, dict[bytes, Exchange]] = {}
    for exchange in sorted(exchanges, key=lambda e: (len(e.step.frame), e.history.frames)):
        frames = by_kind.setdefault(exchange.kind, {})
        if len(frames) < _FRAMES:
            frames.setdefault(exchange.step.frame, exchange)
    return [exchange for frames in by_kind.values() for exchange in frames.values()]


def _chain(last: Exchange) -> list[Exchange]:
    """An exchange behind those before it since power-on, but for those that repeat another."""
    chain, before = [last], last.previous
    while len(chain) < _COUNTED and before:
        chain += [] if repeats(before) else [before]
        before = before.previous
    return chain[::-1]


def _endings(last: Exchange) -> Iterator[list[Exchange]]:
    """The exchange alone, and behind more and more of the frames before it."""
    chain, size = _chain(last)[-_LONGEST:], 1
    while size < len(chain):
        yield chain[-size:]
        size += max(1, size // 4)
    yield chain


def _line(
    chain: Sequence[Exchange], way: Sequence[bytes], timing: Timing, *, together: bool
) -> Line:
    chunks = [Chunk(timing.timeout if together else 0, frame) for frame in way]
    for exchange in chain:
        waited = together and not exchange.ahead
        gap = max(exchange.gap or 0, timing.timeout) if waited else 0
        data = exchange.step.frame
        cuts = [(0, gap), *(exchange.pauses if together else ())]
        ends = [at for at, _ in cuts[1:]] + [len(data)]
        chunks += [Chunk(pause, data[at:end]) for (at, pause), end in zip(cuts, ends, strict=True)]
    chunks[0] = chunks[0]._replace(pause=timing.timeout if together else 0)
    first = chain[0]
    unhomed = not way and first.previous is None and not first.before.unknown
    return Line(tuple(chunks), len(chain) + len(way), together, unhomed)
