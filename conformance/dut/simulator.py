"""The simulated reference device: bytes and times in, answers and looks out. No port, no clock.

Its behaviour follows from the Protocol and conforms by the kit's readings. A Fault changes what it
receives, how it reacts, or what its wheels and LED then do.
"""

from __future__ import annotations

import typing
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import msgspec

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS, Look, look_class
from bilprov.spec.codec import Judgement, judge
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

ReferenceStep = Callable[[bytes, State], tuple[Judgement, State]]


@cache
def conforming_step(protocol: Protocol) -> ReferenceStep:
    """The function from a frame and the state before it to its judgement and the state after it."""
    judged = lru_cache(maxsize=1 << 17)(lambda frame: judge(protocol, frame))

    @lru_cache(maxsize=1 << 17)
    def step(frame: bytes, before: State) -> tuple[Judgement, State]:
        judgement = judged(frame)
        if not judgement.valid:
            return judgement, protocol.on_fault.apply(before)
        assert judgement.instruction is not None
        return judgement, judgement.instruction.effect.apply(before, dict(judgement.fields))

    return step


class Simulator:
    """The reference device, with at most one fault. Times are integers in nanoseconds.

    `latency` (ns) is the time to each answer. `memory` is where a fault keeps what it remembers
    between frames.
    """

    lossless = True

    def __init__(self, protocol: Protocol, fault: Fault | None = None, latency: int = 0) -> None:
        self.protocol = protocol
        self.fault = fault or CONFORMING
        self.latency = latency
        self.byte_time = line_settings(protocol).byte_time
        self.step = conforming_step(protocol)
        self._lengths: Sequence[int] = self.fault.lengths or protocol.lengths
        usual = int(protocol.timing.truncation_timeout * MS)
        timeout = usual if isinstance(self.fault.timeout, str) else self.fault.timeout
        self.timeouts: Sequence[int | None] = [
            self.fault.timeouts(header) if self.fault.timeouts else timeout for header in range(256)
        ]
        self.power_cycle(0)

    def power_cycle(self, now: int) -> None:
        """Switch the device off and on at `now`: it forgets everything."""
        self.state = self.fault.power_on or self.protocol.power_on
        self.frames = self.faults = self.truncated = self.row = 0
        self.memory: dict[str, int] = {}
        self.previous: Judgement | None = None
        self._previous_kind = ""
        self._held = bytearray()
        self._missing = 0
        self._cut: int | None = None  # when (ns) the incomplete frame is truncated
        self._pause = 0
        self._gap: int | None = None
        self._byte_at = now
        self.over_at: int | None = None  # when (ns) the frame before was over
        self._answers: deque[tuple[int, int]] = deque()
        self._states: deque[tuple[int, State]] = deque()
        self._unasked: deque[tuple[int, int]] = deque()
        for code in self.fault.banner:
            self.answer(code, now)

    @property
    def held(self) -> bytes:
        """The bytes of the frame that is not complete yet."""
        return bytes(self._held)

    def drop(self) -> None:
        """Discard the incomplete frame: the next byte is a header."""
        self._held.clear()
        self._cut = None

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        if self._cut is not None or self._states or self._unasked:
            self._settle(now)
        hear = self.fault.hear
        if hear is None:
            for byte in data:
                self._take(byte, now)
        else:
            for index in range(len(data)):
                for byte in hear(self, data[index : index + 1], now):
                    self._take(byte, now)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`; return the bytes the device has sent until then."""
        if self._cut is not None or self._states or self._unasked:
            self._settle(now)
        queue = self._answers
        if not queue or queue[0][0] > now:
            return b""
        due = bytearray()
        while queue and queue[0][0] <= now:
            due.append(queue.popleft()[1])
        return bytes(due)

    def deadline(self) -> int | None:
        """When the device next acts by itself, None if it only waits for bytes."""
        due = self._cut
        for queue in (self._answers, self._states, self._unasked):
            if queue and (due is None or queue[0][0] < due):
                due = queue[0][0]
        return due

    def look(self, now: int) -> Look:
        """What the wheels and the LED do at `now`."""
        self._settle(now)
        protocol, state = self.protocol, self.state
        values = {name: getattr(state, name) for name in protocol.settings}
        values[protocol.car.by] = visible_motion(state)
        left, right = protocol.car.wheels(state, protocol.full_steering)
        looks = look_class(protocol.state_type)
        seen = looks(t=now, moving=state.moving, left=left, right=right, **values)
        return self.fault.show(seen) if self.fault.show else seen

    def probe(self, now: int) -> bytes:
        """The look at `now` as a line of JSON without newline, as a tcp probe sends it."""
        facets = msgspec.to_builtins(self.look(now))
        del facets["t"]
        return msgspec.json.encode(facets)

    def answer(self, code: int, at: int) -> None:
        """Queue an answer byte for the time `at`."""
        queue = self._answers
        if queue and queue[-1][0] > at:
            self._answers = deque(sorted([*queue, (at, code)], key=lambda entry: entry[0]))
        else:
            queue.append((at, code))

    def _take(self, byte: int, now: int) -> None:
        """Take one byte of a frame: start, continue or complete it."""
        held = self._held
        if held:
            held.append(byte)
            self._missing -= 1
            if now - self._byte_at > self._pause:
                self._pause = now - self._byte_at
            if self._missing and not self.fault.whole_frame:
                timeout = self.timeouts[held[0]]
                self._cut = None if timeout is None else now + timeout
        else:
            held.append(byte)
            self._pause = 0
            self._gap = None if self.over_at is None else now - self.over_at
            self._missing = self._lengths[byte]
            if self._missing:
                timeout = self.timeouts[byte]
                self._cut = None if timeout is None else now + timeout
                if self.fault.begins:
                    for code in self.fault.begins(self, byte):
                        self.answer(code, now)
        self._byte_at = now
        if not self._missing:
            self._cut = None
            frame = bytes(held)
            held.clear()
            self._handle(frame, "instruction", now)

    def _settle(self, now: int) -> None:
        """Apply the states, answers and time-outs that are due until `now`, in order of time."""
        while True:
            state = self._states[0][0] if self._states else None
            cut = self._cut
            if cut is not None and cut <= now and (state is None or cut <= state):
                frame = bytes(self._held)
                self._held.clear()
                self._cut = None
                self._handle(frame, "truncated", cut)
                if self.fault.remains:
                    for byte in self.fault.remains(self, frame):
                        self._take(byte, cut)
            elif state is not None and state <= now:
                self.state = self._states.popleft()[1]
            else:
                break
        while self._unasked and self._unasked[0][0] <= now:
            at, code = self._unasked.popleft()
            self.answer(code, at)

    def react_at_header(self, frame: bytes, now: int) -> None:
        """React at `now` (ns) to a frame of which only the header has come."""
        self._pause, self._gap = 0, None if self.over_at is None else now - self.over_at
        self._handle(frame, "instruction", now)

    def _handle(self, frame: bytes, kind: str, known: int) -> None:
        if self.fault.lengths:
            frame = frame[: 1 + self.protocol.lengths[frame[0]]]
        before = self.state
        judgement, after = self.step(frame, before)
        code = judgement.response.code
        if self.fault.react is None:
            self.state = after
            self._states.clear()
            self.answer(code, known + self.latency)
        else:
            gap = self._gap
            event = Event(
                self.protocol,
                judgement,
                before,
                self.frames,
                self.faults,
                kind,
                known,
                self.truncated,
                self.row,
                self.previous,
                self._previous_kind,
                gap,
                self._pause,
                gap is not None and gap <= self.byte_time,
            )
            reaction = self.fault.react(self, event, Reaction(((0, code),), after))
            self.state = reaction.state
            if reaction.later or self._states:
                self._states = deque((known + d, state) for d, state in reaction.later)
            if reaction.unasked or self._unasked:
                self._unasked = deque((known + d, code) for d, code in reaction.unasked)
            for delay, code in reaction.answers:
                self.answer(code, known + self.latency + delay)
        self.frames += 1
        if judgement.valid:
            self.row = 0
        else:
            self.faults += 1
            self.row += 1
            self.truncated += kind == "truncated"
        self.previous, self._previous_kind, self.over_at = judgement, kind, known


# -- faults -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Reaction:
    """How a device reacts to a frame: its answers and its states.

    `answers` are (delay in ns, code); `state` holds at once. `later` are states that follow by
    themselves, (delay in ns, state), and `unasked` answers that do, (delay in ns, code): both are
    dropped when another frame comes.
    """

    answers: tuple[tuple[int, int], ...]
    state: State
    later: tuple[tuple[int, State], ...] = ()
    unasked: tuple[tuple[int, int], ...] = ()


class Event(msgspec.Struct, frozen=True, gc=False):
    """A frame that arrived, with its judgement, the state before it, and the frames before it.

    `frames` and `faults` count the frames before it since power-on, `truncated` the truncated ones,
    `row` the consecutive faults right before it. `kind` is `instruction` or `truncated`, `now` the
    time (ns) when the frame was over. `previous` is the judgement of the frame before, `gap` the
    time (ns) from its end to this frame's header; both None after power-on. `pause` is the longest
    pause (ns) between two of its bytes. `pipelined` is true when its header came too soon for a
    host that waits for the previous answer.
    """

    protocol: Protocol
    judgement: Judgement
    before: State
    frames: int
    faults: int
    kind: str
    now: int
    truncated: int = 0
    row: int = 0
    previous: Judgement | None = None
    previous_kind: str = ""
    gap: int | None = None
    pause: int = 0
    pipelined: bool = False


class FrameTrigger(typing.Protocol):
    """The frames at which a fault shows."""

    def holds(self, event: Event, memory: dict[str, int]) -> bool:
        """Whether the device misbehaves at this frame; `memory` is the trigger's, over a run."""


React = Callable[[Simulator, Event, Reaction], Reaction]
Hear = Callable[[Simulator, bytes, int], bytes]


@dataclass(frozen=True)
class Fault:
    """One named deviation of a device from the document.

    `doc` says in a sentence what it does. `caught_by` are globs of the case ids that are meant to
    fail, `exit` the exit code of a run against it, `clauses` the fields of `spec.fields.Clauses`
    that it breaks (a case that fails names one of them), `needs` is `soak` where only very many
    frames show it. Each other field is a hook or a setting; one left out conforms: `react` changes
    the reaction to a frame, `hear` each byte before it is framed (it may answer at once), `lengths`
    the data length of each header byte, `timeout` (ns, None for never) the pause that truncates a
    frame and `timeouts` the same for each header byte, `whole_frame` counts it from the header on,
    `remains` gives the bytes kept of a truncated frame, `show` changes what a probe sees,
    `power_on` is the state at power-on, `banner` the bytes sent then, `begins` gives the codes
    answered to a header whose data are still to come. A hook knows of the past only its arguments
    and the device's `memory`. The hooks are made of `trigger` and the words `what`.
    """

    name: str
    family: str
    doc: str
    caught_by: tuple[str, ...] = ()
    exit: int = 1
    react: React | None = None
    hear: Hear | None = None
    lengths: Sequence[int] | None = None
    timeout: int | str | None = "default"
    show: Callable[[Look], Look] | None = None
    power_on: State | None = None
    begins: Callable[[Simulator, int], Sequence[int]] | None = None
    clauses: tuple[str, ...] = ()
    needs: str = ""
    timeouts: Callable[[int], int | None] | None = None
    whole_frame: bool = False
    remains: Callable[[Simulator, bytes], bytes] | None = None
    banner: bytes = b""
    trigger: FrameTrigger | None = None
    what: str = ""


CONFORMING = Fault("none", "none", "behaves as the kit reads the document", exit=0)


def answers(reaction: Reaction, *codes: int, delay: int = 0) -> Reaction:
    """The reaction with other answers, `delay` ns after their time."""
    return replace(reaction, answers=tuple((delay, code) for code in codes))
