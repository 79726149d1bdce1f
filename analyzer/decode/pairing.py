"""Pairs device bytes with the instructions they answer, by count, oldest first.

Two taps may timestamp an answer before its instruction, so time never decides a pair; it only
limits the waiting. An answer that no instruction waits for is held for a moment, since its
instruction may be delayed in the other adapter. It uses no port and no clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import msgspec

from bilprov.captures.schemas import MS
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol


class Waiting(msgspec.Struct, frozen=True):
    """An instruction that waits for its answer.

    `end` is the time of its last byte, `expires` when it counts as unanswered (both ns).
    """

    sequence: int
    end: int
    expires: int
    judgement: Judgement


class Held(msgspec.Struct, frozen=True):
    """A device byte that no instruction waits for yet, and its time (ns)."""

    t: int
    byte: int


class Pair(msgspec.Struct, frozen=True):
    """A device byte with the instruction it answers; `passed` are skipped, unanswered ones."""

    held: Held
    waiting: Waiting
    passed: tuple[Waiting, ...] = ()


class Pairing:
    """Queues of the instructions that wait for an answer and of the answers held for one.

    `skew` (ns) is how much earlier than its instruction's last byte an answer may be timestamped.
    """

    def __init__(self, protocol: Protocol, skew: int) -> None:
        timing = protocol.timing
        self._skew = skew
        self.late = round(timing.answer_deadline * MS)
        self._longest = round(timing.answer_longest * MS)
        # A device may take longer than we do to give up on a frame (R-truncation-timeout).
        self._truncation_longest = round(timing.truncation_longest * MS)
        self._waiting: deque[Waiting] = deque()
        self._held: deque[Held] = deque()

    @property
    def idle(self) -> bool:
        """Whether no instruction waits for an answer."""
        return not self._waiting

    @property
    def held(self) -> Held | None:
        """The oldest answer that is held for an instruction, None if there is none."""
        return self._held[0] if self._held else None

    def instruction(self, sequence: int, end: int, judgement: Judgement) -> Iterator[Pair]:
        """Add an instruction that ended (whole or cut short) at `end` (ns); pair a held answer."""
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
        """Pair a device byte that came at `t` (ns); hold it if no instruction waits."""
        held = Held(t, byte)
        if not self._waiting:
            self._held.append(held)
            return
        passed = []
        if self._passes_over(held):
            passed.append(self._waiting.popleft())
        yield Pair(held, self._waiting.popleft(), tuple(passed))

    def _passes_over(self, held: Held) -> bool:
        """Whether the byte answers the second waiting instruction rather than the first.

        This is so only where the first may have gone unanswered, because it was cut short
        (R-truncated-known) or its answer is overdue, and only if the byte is wrong for the first
        and right for the second. Without this rule one lost answer would shift all later pairs
        until the line is idle.
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
        """Remove and return the oldest instruction, which counts as unanswered."""
        return self._waiting.popleft()

    def patience(self, frame_deadline: int | None) -> int | None:
        """When (ns) the oldest held answer is given up, None if none is held.

        `frame_deadline` is when the open frame is cut short, None between frames: the held byte may
        be the answer to that frame.
        """
        if not self._held:
            return None
        end = self._held[0].t + self._skew
        return end if frame_deadline is None else max(end, frame_deadline + self._skew)

    def release(self) -> Held:
        """Remove and return the oldest held answer, which counts as unsolicited."""
        return self._held.popleft()

    def forget(self) -> list[Held]:
        """Clear both queues, because bytes were lost, and return the answers that were held."""
        self._waiting.clear()
        held = list(self._held)
        self._held.clear()
        return held
