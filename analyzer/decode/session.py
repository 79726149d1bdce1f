"""Decodes chunks and line events into records; sniffing, replaying and decoding all use it.

Because there is only this one way, a replayed capture shows what the live run showed. It uses no
port and no clock: the records depend on the events and their times alone. Before each event is
decoded, everything due up to its time comes out, in the order in which it was due.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypedDict

import msgspec

from bilprov.analyzer.decode import anomalies, checkpoint
from bilprov.analyzer.decode.checkpoint import DecoderState
from bilprov.analyzer.decode.decoder import LOSSES, UNREAD, Decoder
from bilprov.analyzer.decode.records import LineRecord, Record
from bilprov.captures.schemas import MS, Checkpoint, Chunk, Direction, Line, Resumption
from bilprov.spec.framing import Framed
from bilprov.spec.protocol import Protocol
from bilprov.spec.synchronise import ANSWER, IDLE, SILENCE, Synchroniser, traffic

SKEW = 20 * MS
"""Ns by which two taps through USB may timestamp an answer before its instruction."""

BOTH: frozenset[Direction] = frozenset({"host", "device"})


class SessionSettings(TypedDict, total=False):
    """The settings of a Session, by name."""

    timeout: int | None
    heard: frozenset[Direction]
    skew: int
    attached: bool


class Session:
    """Decodes one recording from its first event to its last.

    `timeout` (ns) is the longest pause inside a host frame, None for the protocol's own. `heard`
    are the directions that are listened to: with only one, nothing is paired. `skew` (ns) is how
    much earlier than its instruction an answer may be timestamped; 0 where one clock stamps both.
    `attached` is true if listening began at time 0 in running traffic: then the first host byte
    need not be a header, unless the host was silent for the time-out before it. `adapter_pause`
    (ns) is how long an adapter may hold back a part of an answer, where that is longer than
    `timeout`.

    While frame boundaries are unknown (after attaching, and after a loss), events are buffered
    until the boundaries are found, the host pauses for the time-out, or the buffer holds as many
    bytes as four of the longest frames.

    From an event `waited` on nothing was read until the next event: nothing falls due in between,
    and the latency of an answer that is read after it does not count that time.

    At a Resumption decoding goes on from its checkpoint, if that is of this grammar and of these
    settings: what falls due by then comes out, and all else that is under way is dropped silently.
    With any other checkpoint it is a gap, or if it is silent a beginning in running traffic.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        timeout: int | None = None,
        heard: frozenset[Direction] = BOTH,
        skew: int = SKEW,
        attached: bool = False,
        adapter_pause: int = 0,
    ) -> None:
        if timeout is None:
            timeout = round(protocol.timing.truncation_timeout * MS)
        self._protocol = protocol
        self._timeout = timeout
        self._skew = skew
        self._settings = timeout, skew, tuple(sorted(heard))
        self.decoder = Decoder(
            protocol,
            timeout=timeout,
            paired=heard >= BOTH,
            skew=skew,
            answer_pause=max(timeout, skew, adapter_pause),
        )
        # Since when (ns) frame boundaries are unknown and the host is silent; otherwise None.
        self._unsynced_since: int | None = 0 if attached else None
        self._spoken = False  # whether the device has sent a byte since then
        self._resync: Resync | None = None
        self._time = 0

    @property
    def deadline(self) -> int | None:
        """The time (ns) at which `advance` is next needed without an event, None if it is not."""
        return self._resync.deadline if self._resync else self.decoder.deadline

    @property
    def regular(self) -> bool:
        """Whether it is known where frames begin, and nothing odd is under way."""
        hunts = self._resync is not None or self._unsynced_since is not None
        return not hunts and self.decoder.unread_from is None and self.decoder.regular

    def feed(self, event: Chunk | Line) -> list[Record]:
        """Take an event and return the records it completes.

        An event older than the last one is treated as coming at the same time as that.
        """
        if event.t < self._time:
            event = msgspec.structs.replace(event, t=self._time)
        out: list[Record] = []
        self._until(event.t, out)
        self._time = event.t
        if self.decoder.go_on(event.t) and self._unsynced_since is not None:
            self._unsynced_since = event.t  # whether the host was silent is not known
        self._event(event, out)
        return out

    def advance(self, now: int) -> list[Record]:
        """Return the records that fall due up to `now` (ns); no earlier event may follow."""
        out: list[Record] = []
        self._until(now, out)
        return out

    def finish(self, t: int | None = None) -> list[Record]:
        """End the recording, at `t` (ns) or with its last event, and return the last records.

        An incomplete frame is reported as cut short, a held answer as unsolicited. An instruction
        that still waits is not reported, since it is not known whether an answer would have come.
        """
        now = self._time if t is None else t
        out: list[Record] = []
        self._until(now, out)
        self._give_up_hunt(out)
        self._until(now, out)
        self.decoder.finish(self._time, out)
        return out

    def saved(self) -> DecoderState | None:
        """All that is needed to go on from here.

        None while frame boundaries are looked for, or nothing is read.
        """
        if self._resync or self.decoder.unread_from is not None or not self.decoder.settled:
            return None
        return self.decoder.save(
            time=self._time,
            timeout=self._timeout,
            skew=self._skew,
            heard=self._settings[2],
            unsynced_since=self._unsynced_since,
            spoken=self._spoken,
        )

    def resume(self, state: DecoderState) -> None:
        """Go on from a saved state. Raises ValueError if it is of a session with other settings."""
        if (state.timeout, state.skew, state.heard) != self._settings:
            raise ValueError("the state was saved with other settings")
        state.require_sense(self._protocol)
        self.go_on(state)

    def go_on(self, state: DecoderState) -> None:
        """Go on from a state of this very traffic, which needs no check."""
        self._resync = None
        self._time = state.time
        self._unsynced_since, self._spoken = state.unsynced_since, state.spoken
        self.decoder.resume(state)

    def _until(self, now: int, out: list[Record]) -> None:
        """Append what falls due up to `now`; silence of the host ends resynchronisation."""
        if self._resync:
            if now < self._resync.deadline:
                return
            self._resync.silence()
            self._end_hunt(self._resync, out)
        self.decoder.until(now, out)

    def _event(self, event: Chunk | Line, out: list[Record]) -> None:
        """Decode or buffer an event, after all that fell due before it."""
        if isinstance(event, Resumption) and self._resumed(event, out):
            return
        if isinstance(event, Chunk) and not event.data:
            return  # no byte came: no evidence of anything
        if isinstance(event, Chunk) and event.direction == "host":
            self._host(event.data, event.t, out)
        elif isinstance(event, Line) and event.event in (*LOSSES, UNREAD):
            self._give_up_hunt(out)
            self.decoder.until(event.t, out)
            self.decoder.line(event, out)
            if event.event in LOSSES and event.tap != "device":
                self._unsynced_since, self._spoken = event.t, False
        elif self._resync:
            self._resync.other(event)
            if self._resync.over:
                self._end_hunt(self._resync, out)
        else:
            self._spoken = True
            self._decoded(event, out)

    def _resumed(self, event: Resumption, out: list[Record]) -> bool:
        """Go on from the checkpoint; return whether that is all, or the event is still a gap."""
        state = self._fitting(event.checkpoint)
        if state is None:
            if event.silent:
                self._unsynced_since, self._spoken = event.t, False
            return event.silent
        self.go_on(state)
        self._time = max(self._time, event.t)
        if not event.silent:
            gap = event.gap
            out.append(LineRecord(gap, True, state.state, anomalies.of_line(gap, lost=True)))
        return True

    def _fitting(self, found: Checkpoint) -> DecoderState | None:
        """The state in a checkpoint; None if this session cannot go on from it."""
        if found.grammar != self._protocol.sha256 or not found.whole:
            return None
        state = checkpoint.decoded(found.decoder, self._protocol)
        fits = state and (state.timeout, state.skew, state.heard) == self._settings
        return state if fits else None

    def _host(self, data: bytes, now: int, out: list[Record]) -> None:
        """Pass host bytes to resynchronisation one by one, and once it has ended to the decoder.

        That begins with them where it is not known that they begin a frame.
        """
        since, self._unsynced_since = self._unsynced_since, None
        if since is not None and now - since < self._timeout:  # else silence tells that one begins
            if self._protocol.plain:
                self._resync = Resync(
                    self._protocol, self._timeout, self._skew, since, answered=self._spoken
                )
            else:  # a frame of another layout is found by its sync or its check
                self.decoder.doubt(now)
        at = 0
        while self._resync and at < len(data):
            self._resync.host(data[at], now)
            at += 1
            if self._resync.over:
                self._end_hunt(self._resync, out)
        if at < len(data):
            self.decoder.host(data[at:], now, out)

    def _give_up_hunt(self, out: list[Record]) -> None:
        """End resynchronisation, if it is running, without more evidence."""
        if self._resync:
            self._resync.give_up()
            self._end_hunt(self._resync, out)

    def _end_hunt(self, hunt: Resync, out: list[Record]) -> None:
        """Decode the buffered events, each at its own time."""
        self._resync = None
        for event in hunt.settled():
            if isinstance(event, Framed):
                self.decoder.until(event.known, out)
                self.decoder.garbage(event, anomalies.UNCLEAR, out)
            else:
                self.decoder.until(event.t, out)
                self._decoded(event, out)

    def _decoded(self, event: Chunk | Line, out: list[Record]) -> None:
        """Decode an event where frame boundaries are known."""
        if isinstance(event, Line):
            self.decoder.line(event, out)
        elif event.direction == "host":
            self.decoder.host(event.data, event.t, out)
        else:
            self.decoder.device(event.data, event.t, out)


BOUNDARY = 0.75
"""Probability that the first byte heard is a header.

When listening began at a random byte of normal traffic, it was a header in 76 % of the trials. When
listening begins at a random time the share is higher, since a line is idle between frames.
"""

# A place is taken as the first frame boundary if it is one with this probability.
_SURE = 0.99
_LIKELIER = 0.5  # the same when no more evidence can come; a host idle that long is mostly idle
_OTHERS = 1 << 14  # device bytes and line events that are buffered, which no line brings meanwhile
_HELD = 4  # longest frames that are buffered; then the likelier alternative is taken


class Resync:
    """Buffers events from the first host byte until frame boundaries are found.

    `timeout` (ns) is the longest pause within a frame; `skew` (ns) is how long an adapter may
    delay bytes. The host has been silent since `since` (ns); `answered` is true if the device sent
    a byte in that time.
    """

    def __init__(
        self, protocol: Protocol, timeout: int, skew: int, since: int, *, answered: bool
    ) -> None:
        self._timeout = timeout
        # A pause longer than any adapter causes, after which a device may cut a frame short
        # (R-truncation-timeout).
        self._idle = max(skew, round(protocol.timing.truncation_shortest * MS))
        self._most = _HELD * protocol.longest_frame
        self._synchroniser = Synchroniser(traffic(protocol), BOUNDARY)
        self._events: list[Chunk | Line] = []
        self._others = 0
        self._last = since
        self._sure = _SURE
        self._answered = False
        if answered:
            self._anchor_once()

    @property
    def deadline(self) -> int:
        """When (ns) the host has been silent for so long that no frame can be open."""
        return self._last + self._timeout

    @property
    def over(self) -> bool:
        """Whether resynchronisation has ended: boundaries are found, or the buffer is full."""
        held = self._synchroniser.held
        return self._synchroniser.locked or held >= self._most or self._others >= _OTHERS

    def host(self, byte: int, now: int) -> None:
        """Buffer the host's next byte, which came at `now` (ns)."""
        if now - self._last >= self._idle:
            self._synchroniser.anchor(IDLE)
        self._answered = False
        self._last = now
        self._synchroniser.byte(byte)
        self._events.append(Chunk(now, "host", bytes([byte])))

    def other(self, event: Chunk | Line) -> None:
        """Buffer device bytes, or a line event that is not a loss."""
        if isinstance(event, Chunk):
            self._anchor_once()
        self._events.append(event)
        self._others += len(event.data) if isinstance(event, Chunk) else 1
        if self._others >= _OTHERS:
            self.give_up()

    def silence(self) -> None:
        """End resynchronisation at `deadline`: no frame can be open, a boundary is here."""
        self._synchroniser.anchor(SILENCE)
        self.give_up()

    def give_up(self) -> None:
        """End resynchronisation without more evidence: accept the likelier boundary."""
        self._sure = _LIKELIER

    def settled(self) -> Iterator[Chunk | Line | Framed]:
        """Yield the buffered events in order; host bytes before the first frame are one garbage."""
        first = self._synchroniser.first_frame(self._sure)
        before: list[Chunk] = []
        for event in self._events:
            if isinstance(event, Line) or event.direction == "device" or len(before) == first:
                yield event
                continue
            before.append(event)
            if len(before) == first:
                start, end = before[0].t, before[-1].t
                yield Framed("garbage", start, end, end, b"".join(one.data for one in before))

    def _anchor_once(self) -> None:
        """Use an answer as evidence of a boundary; a run without host bytes between counts once."""
        if not self._answered:
            self._answered = True
            self._synchroniser.anchor(ANSWER)
