"""The simulated reference device: bytes and times in, answers and looks out. No port, no clock.

Its behaviour follows from the Protocol and conforms by the kit's readings. A Fault changes what it
receives, how it reacts, or what its wheels and LED then do.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import cache, lru_cache

import msgspec

from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS, Look, look_class
from bilprov.conformance.dut.fault import CONFORMING, Event, Fault, Reaction
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
