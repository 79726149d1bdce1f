"""Pairs device bytes with the instructions they answer, by count, oldest first.

Two taps may timestamp an answer before its instruction, so time never decides a pair; it only
limits the waiting. An answer that no instruction waits for is held for a moment, since its
instruction may be delayed in the other adapter. It uses no port and no clock.
"""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import Final

import msgspec

from bilprov.analyzer.decode.checkpoint import GROUP, WaitingFrames
from bilprov.captures.schemas import MS
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol

MOST: Final = 1 << 15
"""Instructions that wait at a time, and answers that are held: several times what a line carries.

Only a forged file has more, in which a million instructions have the same time. Then the oldest is
given up before its time.
"""


class Waiting(msgspec.Struct, frozen=True, gc=False):
    """An instruction that waits for its answer.

    `end` is the time of its last byte, `expires` when it counts as unanswered (both ns).
    """

    sequence: int
    end: int
    expires: int
    judgement: Judgement


class Held(msgspec.Struct, frozen=True, gc=False):
    """A device byte that no instruction waits for yet, and its time (ns)."""

    t: int
    byte: int


class Pairing:
    """Queues of the instructions that wait for an answer and of the answers held for one.

    `skew` (ns) is how much earlier than its instruction's last byte an answer may be timestamped.
    `waiting` and `held` are the queues, the oldest first; one of them is empty at any time, and the
    other has `most` entries at most.
    """

    def __init__(self, protocol: Protocol, skew: int) -> None:
        timing = protocol.timing
        self._skew = skew
        self.most = MOST
        self.late = round(timing.answer_deadline * MS)
        self.longest = round(timing.answer_longest * MS)
        # A device may take longer than we do to give up on a frame (R-truncation-timeout).
        self._truncation_longest = round(timing.truncation_longest * MS)
        self.waiting: deque[Waiting] = deque()
        self.held: deque[Held] = deque()

    def wait(self, sequence: int, end: int, judgement: Judgement) -> Waiting:
        """The Waiting of an instruction that ended (whole or cut short) at `end` (ns)."""
        expires = end + self.longest
        if judgement.truncated:
            expires += self._truncation_longest
        waiting = self.waiting
        if waiting and waiting[-1].expires > expires:
            expires = waiting[-1].expires  # answers come in order: none is given up before
        return Waiting(sequence, end, expires, judgement)

    def passes_over(self, held: Held) -> bool:
        """Whether the byte answers the second waiting instruction rather than the first.

        This is so only where the first may have gone unanswered, because it was cut short
        (R-truncated-known) or its answer is overdue, and only if the byte is wrong for the first
        and right for the second. Without this rule one lost answer would shift all later pairs
        until the line is idle.
        """
        if len(self.waiting) < 2:
            return False
        first, second = self.waiting[0], self.waiting[1]
        overdue = first.judgement.truncated or held.t - first.end > self.late
        return (
            overdue
            and held.byte != first.judgement.response.code
            and held.byte == second.judgement.response.code
        )

    def patience(self, frame_deadline: int | None) -> int | None:
        """When (ns) the oldest held answer is given up, None if none is held.

        `frame_deadline` is when the open frame is cut short, None between frames: the held byte may
        be the answer to that frame.
        """
        if not self.held:
            return None
        end = self.held[0].t + self._skew
        return end if frame_deadline is None else max(end, frame_deadline + self._skew)

    def forget(self) -> list[Held]:
        """Clear both queues, because bytes were lost, and return the answers that were held."""
        self.waiting.clear()
        held = list(self.held)
        self.held.clear()
        return held


class WaitingGroups:
    """Puts the instructions that wait together as WaitingFrames, by what it made the last time.

    Their numbers follow each other; those that a number was given to before stay as they were.
    """

    def __init__(self) -> None:
        self._groups: deque[tuple[int, WaitingFrames]] = deque()  # with the first one's number
        self._next = 0  # the number of the first instruction that is in none of them
        self._open = False  # whether another one may go into the last of them

    def of(self, waiting: deque[Waiting]) -> tuple[WaitingFrames, ...]:
        """The groups of all: neighbours with equal times, as far as one that was cut short."""
        if not waiting:
            self._groups.clear()
            return ()
        groups, first, end = self._groups, waiting[0].sequence, waiting[-1].sequence + 1
        if not groups or self._next <= first:
            groups.clear()
            self._next = first
        while len(groups) > 1 and groups[1][0] <= first:
            groups.popleft()
        if groups and groups[0][0] < first:
            after = groups[1][0] if len(groups) > 1 else self._next
            left = b"".join(one.judgement.frame for one in islice(waiting, after - first))
            groups[0] = first, msgspec.structs.replace(groups[0][1], frames=left)
        for one in reversed(list(islice(reversed(waiting), end - self._next))):
            self._add(one)
        self._next = end
        return tuple(group for _, group in groups)

    def _add(self, one: Waiting) -> None:
        frame, number = one.judgement.frame, one.sequence
        last = self._groups[-1][1] if self._groups else None
        times = last and (last.end, last.expires)
        if last and self._open and number % GROUP and times == (one.end, one.expires):
            grown = msgspec.structs.replace(last, frames=last.frames + frame)
            self._groups[-1] = self._groups[-1][0], grown
        else:
            self._groups.append((number, WaitingFrames(one.end, one.expires, frame)))
        self._open = not one.judgement.truncated
