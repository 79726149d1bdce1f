"""Decodes a stream of events: much regular traffic at once, all else by a Session.

The rows are those of one Session from the first event to the last, in the same order: each batch
goes on from the state in which the one before it has ended. numpy is loaded with the first events.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.records import Record
from bilprov.analyzer.decode.session import BOTH, SKEW, Session
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.decode.columns import Carry, ColumnDecoder
    from bilprov.captures.events import Events

LEAST = 1024
"""Bytes from which on single events are decoded as arrays; fewer are decoded faster one by one."""

# After an event that is not regular, so many go through the Session; more and more if none of
# those that follow is regular, so that an irregular line costs little more than a Session alone.
_FEWEST, _MOST = 1, 1024
_BYTES = 1 << 18  # bytes that are decoded at once, so that their arrays fit into a cache
_SHORTEST = 64  # events tried at once after an irregular one


def preload(protocol: Protocol) -> None:
    """Make now what decoding needs, and not in the first busy moment of a line."""
    _column_decoder(protocol, 0, SKEW, True)


def _column_decoder(
    protocol: Protocol, timeout: int, skew: int, paired: bool
) -> ColumnDecoder | None:
    """The decoder into columns; None for a protocol that does not fit into them."""
    from bilprov.analyzer.decode.columns import ColumnDecoder

    with suppress(OverflowError):
        return ColumnDecoder(protocol, timeout=timeout, skew=skew, paired=paired)
    return None


class StreamDecoder:
    """Decodes one recording from its first event to its last, in batches.

    The settings are those of a Session, whose records the batches have.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        timeout: int | None = None,
        heard: frozenset[Direction] = BOTH,
        skew: int = SKEW,
        attached: bool = False,
    ) -> None:
        if timeout is None:
            timeout = round(protocol.timing.truncation_timeout * MS)
        self._session = Session(
            protocol, timeout=timeout, heard=heard, skew=skew, attached=attached
        )
        self._protocol = protocol
        self._settings = timeout, skew, heard >= BOTH
        self._regular: ColumnDecoder | None = None
        self._loaded = False  # whether that is all there will be of it
        self._carry: Carry | None = None  # what the last batch left, while the Session rests
        self._direct = _FEWEST
        self._alone = 0  # events still to come that go through the Session
        self._window = _MOST

    @property
    def deadline(self) -> int | None:
        """The time (ns) at which `advance` is next needed without an event, None if it is not."""
        if self._carry is not None and self._regular is not None:
            return self._regular.deadline(self._carry)
        return self._session.deadline

    def feed(self, events: Sequence[Chunk | Line]) -> list[Batch]:
        """Take the next events, one by one as they are, and return what they complete."""
        if sum([len(event.data) for event in events if type(event) is Chunk]) >= LEAST:
            from bilprov.captures.events import Events

            return self.decode(Events.of(events))
        return self._feed_session(events)

    def decode(self, events: Events) -> list[Batch]:
        """Take the next events and return what they complete."""
        batches: list[Batch] = []
        at = 0
        while at < len(events):
            if not self._alone and self._enter_columns():
                window = events.part(at, self._stop(events, at))
                assert self._regular is not None
                assert self._carry is not None
                batch, used, self._carry = self._regular.decode(self._carry, window)
                batches += [batch] if used else []
                at += used
                if used == len(window):
                    self._direct, self._window = _FEWEST, self._window * 2
                    continue
                self._window = max(_SHORTEST, 2 * used)
            if not self._alone:
                self._alone, self._direct = self._direct, min(_MOST, 2 * self._direct)
            after = min(at + self._alone, len(events))
            self._alone -= after - at
            batches += self._feed_session(list(events.part(at, after).single()))
            at = after
        self._window = max(self._window, _MOST)
        return batches

    def advance(self, now: int) -> list[Batch]:
        """Return what falls due up to `now` (ns); no earlier event may follow."""
        due = self.deadline
        if due is None or now < due:
            return []
        return _batch(self._leave_columns().advance(now))

    def finish(self, t: int | None = None) -> list[Batch]:
        """End the recording, at `t` (ns) or with its last event, and return what is left."""
        return _batch(self._leave_columns().finish(t))

    def saved(self) -> DecoderState | None:
        """All that is needed to go on from here; None while frame boundaries are looked for."""
        if self._carry is not None and self._regular is not None:
            return self._regular.saved(self._carry)
        return self._session.saved()

    def resume(self, state: DecoderState) -> None:
        """Go on from a saved state. Raises ValueError if it is of a session with other settings."""
        self._session.resume(state)
        self._carry = None

    def _stop(self, events: Events, at: int) -> int:
        """The end of the events from `at` on that are decoded at once."""
        begun = int(events.end[at - 1]) if at else 0
        fit = int(events.end.searchsorted(begun + _BYTES, "right"))
        return min(at + self._window, max(fit, at + 1))

    def _feed_session(self, events: Sequence[Chunk | Line]) -> list[Batch]:
        session = self._leave_columns()
        return _batch([record for event in events for record in session.feed(event)])

    def _enter_columns(self) -> bool:
        """Hand over from the Session, if it can be; return whether the columns are in charge."""
        if self._carry is not None:
            return True
        if not self._loaded:
            self._regular = _column_decoder(self._protocol, *self._settings)
            self._loaded = True
        if self._regular is None or not self._session.regular:
            return False
        state = self._session.saved()
        if state is not None:
            self._carry = self._regular.carry(state, self._session.decoder.begun)
        return self._carry is not None

    def _leave_columns(self) -> Session:
        """Hand over to the Session, if it is not in charge, and return it."""
        if self._carry is not None and self._regular is not None:
            self._session.go_on(self._regular.state(self._carry))
            self._session.decoder.hold(self._regular.begun(self._carry))
            self._carry = None
        return self._session


def _batch(records: list[Record]) -> list[Batch]:
    """The batch of records that were decoded one by one; none of no records."""
    from bilprov.analyzer.decode.batch import Records

    return [Records(records)] if records else []
