"""The shortest line of frames that shows a cause on a device that was just brought to rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from bilprov.analyzer.client.operations import Procedure, drive, followed, listen, observe, send
from bilprov.analyzer.client.rest import home_once
from bilprov.captures.schemas import MS
from bilprov.conformance.causes.exchanges import Exchange, Exchanges, Timing
from bilprov.conformance.causes.features import Feature, matches
from bilprov.conformance.causes.relations import Effect
from bilprov.conformance.causes.trace import Trace
from bilprov.conformance.dut.link import Device
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.virtual_link import VirtualLink
from bilprov.conformance.oracle.choices import Choices
from bilprov.conformance.oracle.state_model import Model
from bilprov.spec.by_effect import frames_to
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.conformance.causes.causes import Cause

_FRAMES = 2
"""Frames under test of each kind from which the shortest line is chosen."""
_TRIES = 300
"""Lines that are tried on the simulator at most."""
_LONGEST = 160
"""Frames of a line at most."""
_COUNTED = 400
"""Frames that only count, at most."""
_SETTLED = 20 * MS
"""How long (ns) a device has for a change after its last answer, before it is looked at again."""
_DELIVERY = {"ahead", "sent ahead", "split", "pause", "gap"}
"""Features that only frames sent by their times, and not by their answers, show."""


class Chunk(NamedTuple):
    """Bytes that are sent in one go, `pause` ns after those before."""

    pause: int
    data: bytes


class Line(NamedTuple):
    """Frames to send. With `together` their answers are not waited for."""

    chunks: tuple[Chunk, ...]
    frames: int
    together: bool = False

    @property
    def half(self) -> Line:
        """The last half of its frames."""
        kept = self.chunks[len(self.chunks) // 2 :]
        return Line(kept, len(kept), self.together)

    @property
    def words(self) -> tuple[str, ...]:
        """The arguments of `bilprov send PORT`."""
        words = ["--together"] if self.together else []
        for chunk in self.chunks:
            words += [f"pause={-(-chunk.pause // MS)}"] if chunk.pause else []
            words.append(chunk.data.hex(" "))
        return tuple(words)


def shown_by(line: Line, timing: Timing, watched: int = 0, *, looks: bool) -> Procedure[None]:
    """Send a line to a device at rest, hear its answers, and look at it if `looks`.

    The last look comes `watched` ns after the last answer: what changes by itself needs time.
    """
    patience = timing.longest + timing.timeout
    for pause, data in line.chunks:
        if pause:
            yield from listen(None, pause)
        yield from send(data)
        if not line.together:
            yield from listen(1, patience)
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
    """Home a device object, send it a line and look at it as `shown_by` does."""
    trace = Trace()

    def attempt() -> Procedure[None]:
        yield from home_once(model.protocol)
        trace.begin("")
        yield from shown_by(line, timing, watched, looks=True)

    drive(followed(attempt(), trace), VirtualLink(device, timing.byte_time))
    return Exchanges(model, trace.events, timing)


class Finder:
    """Finds the line for a cause; a conforming simulator shows what each line would bring about."""

    def __init__(self, protocol: Protocol, timing: Timing) -> None:
        self._protocol = protocol
        self._timing = timing

    def lines(self, cause: Cause) -> list[Line]:
        """Return lines to try, in this order, until one shows the cause.

        The first is the shortest at whose last frame the cause would show by all that is known of
        it. The others come nearer to where it showed in the run.
        """
        clear = [e for e in cause.exchanges if not e.before.unknown and cause.foresees(e)]
        simplest = _simplest(clear or cause.exchanges)[0]
        counted = self._counted(cause, simplest)
        return list(dict.fromkeys((self._shortest(cause), *counted, self._as_met(simplest))))

    def _as_met(self, last: Exchange) -> Line:
        """The frames of the case up to one at which it showed, by the times of the run."""
        chain = [last]
        while len(chain) < _LONGEST and chain[0].previous and chain[0].previous.case == last.case:
            chain.insert(0, chain[0].previous)
        return _line(chain, (), self._timing, together=any(one.ahead for one in chain))

    def _counted(self, cause: Cause, last: Exchange) -> Iterator[Line]:
        """As many frames before it as the cause counts; then it is also sent again and again.

        Where it shows from some number on, it is not certain what the device counts: it may be all
        frames, or how often this one came so far.
        """
        counted = [literal for literal in cause.rule if literal.feature.counts]
        way = () if last.before.unknown else frames_to(self._protocol, last.before.state)
        once = _line([last], way, self._timing, together=False).chunks
        for times in (1, _LONGEST // len(once)) if counted else ():
            chunks = once * times
            for literal in counted:
                missing, sent = last.history.frames, self._last(Line(chunks, len(chunks)))
                if literal.operator == "every" and sent:
                    missing = literal.missing(sent)
                counting = Chunk(0, _counting(literal.feature, last))
                chunks = (counting,) * min(missing, _COUNTED) + chunks
            yield Line(chunks, len(chunks))

    def _shortest(self, cause: Cause) -> Line:
        """The shortest line at whose last frame the cause would show.

        Where there is none (the cause depends on more than a line can hold), it is the shortest of
        those that end in a frame of the cause.
        """
        lines = sorted(self._lines(cause), key=lambda one: (one.frames, len(one.chunks)))
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
        together = any(literal.feature.name in _DELIVERY for literal in cause.rule)
        for last in _simplest(cause.exchanges):
            for chain in _endings(last):
                before = chain[0].before
                way = () if before.unknown else frames_to(self._protocol, before.state)
                yield _line(chain, (), self._timing, together=together)
                if way:
                    yield _line(chain, way, self._timing, together=together)

    def _last(self, line: Line) -> Exchange | None:
        """The last exchange of a line on the simulator."""
        model, device = Model(self._protocol, Choices()), Simulator(self._protocol)
        sent = exchanged(line, self._timing, model, device).all
        return sent[-1] if sent else None

    def _shortened(self, cause: Cause, shown: Sequence[Effect], line: Line) -> Line:
        """The line without the frames that it does not need."""
        size = len(line.chunks) // 2
        while size:
            for start in range(0, len(line.chunks) - size, size):
                left = line.chunks[:start] + line.chunks[start + size :]
                shorter = line._replace(chunks=left, frames=line.frames - size)
                last = None if line.together else self._last(shorter)
                if last and _shown(cause, shown, last):
                    line = shorter
                    break
            else:
                size //= 2
        return line


def shows(cause: Cause, exchanges: Exchanges) -> bool:
    """Return whether the last of these exchanges deviates as the cause says."""
    return bool(exchanges.all) and any(
        bag.deviation.facet == effect.relation.facet
        and exchanges.all[-1] in bag.exchanges
        and effect.relation.explains(bag)
        for bag in exchanges.bags
        for effect in cause.effects
    )


def _shown(cause: Cause, effects: Sequence[Effect], exchange: Exchange) -> bool:
    """Whether these effects of a cause would all show at an exchange."""
    differ = all(effect.relation.differs(exchange) for effect in effects)
    return differ and matches(cause.rule, exchange)


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


def _endings(last: Exchange) -> Iterator[list[Exchange]]:
    """The exchange alone, and after more and more of the frames before it since power-on."""
    chain, size = [last], 1
    while True:
        while len(chain) < size and chain[0].previous is not None:
            chain.insert(0, chain[0].previous)
        yield list(chain)
        if chain[0].previous is None or size >= _LONGEST:
            return
        size += max(1, size // 4)


def _line(
    chain: Sequence[Exchange], way: Sequence[bytes], timing: Timing, *, together: bool
) -> Line:
    chunks = [Chunk(timing.timeout if together else 0, frame) for frame in way]
    for exchange in chain:
        waited = together and not exchange.ahead
        first = max(exchange.gap or 0, timing.timeout) if waited else 0
        data = exchange.step.frame
        cuts = [(0, first), *(exchange.pauses if together else ())]
        ends = [at for at, _ in cuts[1:]] + [len(data)]
        chunks += [Chunk(pause, data[at:end]) for (at, pause), end in zip(cuts, ends, strict=True)]
    chunks[0] = chunks[0]._replace(pause=0)
    return Line(tuple(chunks), len(chain) + len(way), together)
