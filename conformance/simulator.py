"""The reference device, made from the Protocol: bytes and times in, answers and looks out.

It does what the kit's readings call conforming, unless it is given a Fault, which changes what it
hears, how it reacts, or what its wheels and LED then do. No port, no clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import msgspec

from captures.schemas import Look
from spec.codec import Judgement, judge
from spec.framing import Framed, Framer
from spec.motion import State, wheels
from spec.protocol import Protocol

MS = 1_000_000


@dataclass(frozen=True, slots=True)
class Reaction:
    """What a frame brings about.

    `answers` are (delay in ns, code); `state` holds at once; `later` are states that come by
    themselves: (delay in ns, state).
    """

    answers: tuple[tuple[int, int], ...]
    state: State
    later: tuple[tuple[int, State], ...] = ()


@dataclass(frozen=True, slots=True)
class Event:
    """A frame that arrived: its judgement, the state before it, how many came before it."""

    judgement: Judgement
    before: State
    frames: int
    faults: int
    kind: str
    now: int


React = Callable[["Simulator", Event, Reaction], Reaction]


@dataclass(frozen=True)
class Fault:
    """One named way to misbehave.

    `doc` says in a sentence what it does. `caught_by` are globs of the case ids that are meant to
    fail, `exit` the exit code of a run against it. What is left out behaves well: `react` changes
    the reaction to a frame, `hear` the bytes before they are framed (and may answer at once),
    `lengths` the data length of each header byte, `timeout` (ns, None for never) the pause that
    cuts a frame short, `show` what a probe can see, `power_on` the state it starts in, `begins`
    what happens when a header has arrived.
    """

    name: str
    family: str
    doc: str
    caught_by: tuple[str, ...] = ()
    exit: int = 1
    react: React | None = None
    hear: Callable[[Simulator, bytes, int], bytes] | None = None
    lengths: Sequence[int] | None = None
    timeout: int | str | None = "default"
    show: Callable[[Look], Look] | None = None
    power_on: State | None = None
    begins: Callable[[Simulator, int], Sequence[int]] | None = None


CONFORMING = Fault("none", "none", "behaves as the kit reads the document", exit=0)


@dataclass
class _Pending:
    """What is still to come, in order of time: answer bytes and states."""

    answers: deque[tuple[int, int]] = field(default_factory=deque)
    states: deque[tuple[int, State]] = field(default_factory=deque)


class Simulator:
    """The reference device, with at most one fault. Times are integers in nanoseconds."""

    def __init__(self, protocol: Protocol, fault: Fault | None = None, latency: int = 0) -> None:
        self.protocol = protocol
        self.fault = fault or CONFORMING
        self.latency = latency
        self._judge = lru_cache(maxsize=1 << 17)(partial(judge, protocol))
        self._full_steering = max(abs(end) for end in protocol.limits.get("steering", (0, 0)))
        self.power_cycle(0)

    def power_cycle(self, now: int) -> None:
        """Switch it off and on at `now`: it knows nothing of what was before."""
        timeout = self.fault.timeout
        self._framer = Framer(
            self.fault.lengths or self.protocol.lengths,
            int(self.protocol.timing.truncation_timeout * MS)
            if isinstance(timeout, str)
            else timeout,
        )
        self.state = self.fault.power_on or self.protocol.power_on
        self.frames = 0
        self.faults = 0
        self.memory: dict[str, int] = {}
        self._pending = _Pending()

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._settle(now)
        if self.fault.hear:
            data = self.fault.hear(self, data, now)
        for byte in data:
            fresh = not self._framer.held
            records = self._framer.feed(bytes([byte]), now)
            if fresh and not records and self.fault.begins:
                for code in self.fault.begins(self, byte):
                    self.answer(code, now)
            for record in records:
                self._handle(record)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`: what the device sends until then."""
        self._settle(now)
        due = bytearray()
        while self._pending.answers and self._pending.answers[0][0] <= now:
            due.append(self._pending.answers.popleft()[1])
        return bytes(due)

    def deadline(self) -> int | None:
        """When it next acts by itself, None if it only waits."""
        times = [queue[0][0] for queue in (self._pending.answers, self._pending.states) if queue]
        if self._framer.deadline is not None:
            times.append(self._framer.deadline)
        return min(times, default=None)

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
        self._settle(now)
        left, right = wheels(self.state, self._full_steering)
        seen = Look(
            t=now,
            moving=self.state.moving,
            motion=self.state.visible_motion.value,
            speed=self.state.speed,
            steering=self.state.steering,
            led=self.state.led,
            left=left,
            right=right,
        )
        return self.fault.show(seen) if self.fault.show else seen

    def probe(self, now: int) -> bytes:
        """The look as the probe's line of JSON."""
        facets = msgspec.to_builtins(self.look(now))
        del facets["t"]
        return msgspec.json.encode(facets)

    def answer(self, code: int, at: int) -> None:
        """Queue an answer byte for the time `at`."""
        queue = self._pending.answers
        queue.append((at, code))
        if len(queue) > 1 and queue[-2][0] > at:
            self._pending.answers = deque(sorted(queue, key=lambda entry: entry[0]))

    def _settle(self, now: int) -> None:
        """Apply the states and time-outs that are due until `now`, in order of time."""
        while True:
            state = self._pending.states[0][0] if self._pending.states else None
            cut = self._framer.deadline
            if cut is not None and cut <= now and (state is None or cut <= state):
                for record in self._framer.advance(cut):
                    self._handle(record)
            elif state is not None and state <= now:
                self.state = self._pending.states.popleft()[1]
            else:
                return

    def _handle(self, record: Framed) -> None:
        lengths = self.protocol.lengths
        whole = record.data[: 1 + lengths[record.data[0]]]
        judgement = self._judge(whole)
        if judgement.valid:
            effect, fields = judgement.instruction, dict(judgement.fields)
            after = effect.effect.apply(self.state, fields) if effect else self.state
        else:
            after = self.protocol.on_fault.apply(self.state)
        event = Event(judgement, self.state, self.frames, self.faults, record.kind, record.known)
        reaction = Reaction(((0, judgement.response.code),), after)
        if self.fault.react:
            reaction = self.fault.react(self, event, reaction)
        self.frames += 1
        self.faults += not judgement.valid
        self.state = reaction.state
        self._pending.states.clear()
        self._pending.states.extend((record.known + d, state) for d, state in reaction.later)
        for delay, code in reaction.answers:
            self.answer(code, record.known + self.latency + delay)


def answers(reaction: Reaction, *codes: int, delay: int = 0) -> Reaction:
    """The reaction with other answers, `delay` ns after their time."""
    return replace(reaction, answers=tuple((delay, code) for code in codes))
