"""Which instruction a device byte answers: by count, oldest first. No port, no clock.

Two taps may stamp an answer before its instruction, so time never decides a pair; it only says
when waiting has an end. An answer that nothing waits for is held for a moment, since its
instruction may be on its way through the other adapter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import msgspec

from spec.codec import Judgement
from spec.protocol import Protocol

MILLISECOND = 1_000_000  # ns


class Waiting(msgspec.Struct, frozen=True):
    """An instruction that waits for its answer.

    `end` is the time of its last byte, `expires` when it counts as unanswered (both ns).
    """

    sequence: int
    end: int
    expires: int
    judgement: Judgement


class Held(msgspec.Struct, frozen=True):
    """A device byte that nothing waits for yet, and its time (ns)."""

    t: int
    byte: int


class Pair(msgspec.Struct, frozen=True):
    """A device byte with the instruction it answers; `passed` are those it showed unanswered."""

    held: Held
    waiting: Waiting
    passed: tuple[Waiting, ...] = ()


class Pairing:
    """The instructions that wait for an answer and the answers that wait for an instruction.

    `skew` (ns) is how far an answer may be stamped before its instruction's last byte.
    """

    def __init__(self, protocol: Protocol, skew: int) -> None:
        timing = protocol.timing
        self._skew = skew
        self.late = round(timing.answer_deadline * MILLISECOND)
        self._longest = round(timing.answer_longest * MILLISECOND)
        # A device may take longer than we do to give up on a frame (R-truncation-timeout).
        self._truncation_longest = round(timing.truncation_longest * MILLISECOND)
        self._waiting: deque[Waiting] = deque()
        self._held: deque[Held] = deque()

    @property
    def idle(self) -> bool:
        """Whether no instruction waits for an answer."""
        return not self._waiting

    @property
    def held(self) -> Held | None:
        """The oldest answer that waits for an instruction, None if there is none."""
        return self._held[0] if self._held else None

    def instruction(self, sequence: int, end: int, judgement: Judgement) -> Iterator[Pair]:
        """An instruction is over (whole or cut short); an answer held for it is given to it."""
        longest = self._longest + (self._truncation_longest if judgement.truncated else 0)
        expires = end + longest
        if self._waiting:  # answers come in order: none is given up before one that came earlier
            expires = max(expires, self._waiting[-1].expires)
        waiting = Waiting(sequence, end, expires, judgement)
        if self._held:
            yield Pair(self._held.popleft(), waiting)
        else:
            self._waiting.append(waiting)

    def answer(self, byte: int, t: int) -> Iterator[Pair]:
        """A device byte came at `t` (ns); without an instruction for it, it is held."""
        held = Held(t, byte)
        if not self._waiting:
            self._held.append(held)
            return
        passed = []
        if self._passes_over(held):
            passed.append(self._waiting.popleft())
        yield Pair(held, self._waiting.popleft(), tuple(passed))

    def _passes_over(self, held: Held) -> bool:
        """Whether the byte is rather the answer to the second instruction that waits.

        Only where the first may have gone unanswered, because it was cut short (R-truncated-known)
        or because its answer is overdue, and only if the byte is wrong for it and right for the
        second: without this one lost answer would shift all that follow until the line is idle.
        """
        if len(self._waiting) < 2:
            return False
        first, second = self._waiting[0], self._waiting[1]
        overdue = first.judgement.truncated or held.t - first.end > self.late
        return (
            overdue
            and held.byte != first.judgement.response.code
            and held.byte == second.judgement.response.code
        )

    @property
    def expiry(self) -> int | None:
        """When (ns) the oldest instruction counts as unanswered, None if none waits."""
        return self._waiting[0].expires if self._waiting else None

    def expire(self) -> Waiting:
        """Take the oldest instruction: its time is over."""
        return self._waiting.popleft()

    def patience(self, frame_deadline: int | None) -> int | None:
        """When (ns) the oldest held answer is given up, None if none is held.

        `frame_deadline` is when the frame begun is cut short, None between frames: what is held may
        be its answer.
        """
        if not self._held:
            return None
        end = self._held[0].t + self._skew
        return end if frame_deadline is None else max(end, frame_deadline + self._skew)

    def release(self) -> Held:
        """Give up the oldest held answer."""
        return self._held.popleft()

    def forget(self) -> list[Held]:
        """Start anew, because bytes were lost: nothing waits any more; what was held comes out."""
        self._waiting.clear()
        held = list(self._held)
        self._held.clear()
        return held
