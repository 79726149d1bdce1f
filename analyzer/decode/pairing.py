"""Pairs device bytes with the instructions they answer, by count, oldest first.

Two taps may timestamp an answer before its instruction, so time never decides a pair; it only
limits the waiting. An answer that no instruction waits for is held for a moment, since its
instruction may be delayed in the other adapter. Answers of more than one byte are cut by the
requests that wait for one. It uses no port and no clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from bilprov.analyzer.decode.checkpoint import WaitingFrames
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import Reply, read_reply, repeated_id, reply_size

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
    """A device byte, or an answer of several, and its time (ns).

    `byte` is the code of an answer of several bytes, -1 if it has none.
    """

    t: int
    byte: int
    reply: Reply | None = None


def passes_over(held: Held, waiting: Sequence[Waiting], late: int) -> bool:
    """Whether the byte answers the second waiting instruction rather than the first.

    This is so only where the first may have gone unanswered, because it was cut short
    (R-truncated-known) or its answer is overdue (after `late` ns), and only if the byte is wrong
    for the first and right for the second. Without this rule one lost answer would shift all later
    pairs until the line is idle.
    """
    if len(waiting) < 2:
        return False
    first, second = waiting[0], waiting[1]
    overdue = first.judgement.truncated or held.t - first.end > late
    codes = first.judgement.response.code, second.judgement.response.code
    return overdue and codes[0] != held.byte == codes[1]


def waiting_frames(
    waiting: Iterable[Waiting], *, numbered: bool = False
) -> tuple[WaitingFrames, ...]:
    """Instructions that wait: neighbours with equal times together, as far as one cut short.

    With `numbered` there may be some between them that are not answered.
    """
    groups: list[list[Waiting]] = []
    for one in waiting:
        last = groups[-1][-1] if groups else None
        if (
            last is None
            or last.judgement.truncated
            or (last.end, last.expires) != (one.end, one.expires)
            or (numbered and last.sequence + 1 != one.sequence)
        ):
            groups.append([])
        groups[-1].append(one)
    return tuple(
        WaitingFrames(
            group[0].end,
            group[0].expires,
            b"".join([one.judgement.frame for one in group]),
            group[0].sequence if numbered else None,
        )
        for group in groups
    )


_LOOKED_AT = 64  # requests at most for a pause among them; hosts send few without an answer


class Heard(NamedTuple):
    """An answer, the times (ns) of its first and last byte, and how many requests it passes over.

    Those were sent before the one that it answers, and are not answered. One that is `loose`
    answers none of the requests that wait.
    """

    reply: Reply
    start: int
    end: int
    passed: int = 0
    loose: bool = False


class ReplyFramer:
    """Holds the bytes of answers that are not complete; `timeout` (ns) is the longest pause."""

    def __init__(self, protocol: Protocol, timeout: int) -> None:
        self._protocol = protocol
        self._timeout = timeout
        layouts = (protocol.reply, protocol.acknowledgement, *protocol.errors)
        self._starts = {layout.sync[:1] for layout in layouts}  # b"": an answer without a sync
        self._held = bytearray()
        self._times: list[int] = []
        # Up to `_looked` no right answer begins behind the first byte, unless at an `_open` place,
        # whose answer is not whole yet. So no place is looked at for every byte that comes.
        self._looked = 1
        self._open: list[int] = []

    @property
    def held(self) -> bool:
        """Whether bytes are held."""
        return bool(self._held)

    @property
    def deadline(self) -> int | None:
        """When (ns) what is held is over; None if nothing is held."""
        return self._times[-1] + self._timeout if self._times else None

    def feed(self, data: bytes, now: int) -> None:
        """Take bytes that came at `now` (ns)."""
        self._held += data
        self._times += [now] * len(data)

    def forget(self) -> None:
        """Drop what is held."""
        self._held.clear()
        self._times.clear()
        self._looked, self._open = 1, []

    def delay(self, pause: int) -> None:
        """Let what is held have come so much (ns) later."""
        self._times = [t + pause for t in self._times]

    def take(
        self, waiting: Sequence[Waiting], gives_up: int, *, over: bool = False
    ) -> Heard | None:
        """Take the next answer to the requests that wait, the oldest first; None if none is whole.

        Where none waits it is one that no request was heard of. `over` says that no more bytes
        follow. Bytes that are no answer are taken up to where a right one begins.
        """
        found, is_open = self._first(waiting, gives_up) if waiting else self._unasked()
        if found is None and is_open and not over:
            return None
        if found is None or found.reply.reason:
            end = len(found.reply.frame) if found else len(self._held)
            begun = self._right_place(waiting, end, checked=found is not None)
            found = found if begun is None else self._before(begun, waiting, is_open or found)
        return found and self._taken(found)

    def take_before(self, t: int) -> Heard | None:
        """Take a right answer that came before `t` (ns), when no request waited; None if none did.

        So it answers none that is sent later.
        """
        found, _ = self._unasked() if self._held else (None, False)
        early = found and not found.reply.reason and found.end < t
        return self._taken(found) if found and early else None

    def _first(self, waiting: Iterable[Waiting], gives_up: int) -> tuple[Heard | None, bool]:
        """The first answer to the requests that wait, and whether one may be incomplete.

        A right answer to a later one passes over those before it. Where it is right for several it
        is that to the first after the last pause of `gives_up` (ns): a host that pauses so long
        without an answer, and then sends another request, does not wait for the first any more.
        """
        held = bytes(self._held)
        right: Heard | None = None
        damaged: Heard | None = None
        paused, before, is_open = False, None, False
        for passed, one in enumerate(waiting):
            paused = paused or (before is not None and one.end - before >= gives_up)
            before = one.end
            if right and not paused:
                if passed < _LOOKED_AT:
                    continue
                break
            size = reply_size(self._protocol, held, one.judgement)
            if size is None or size > len(held):
                is_open = True
                break
            if size < 0:
                continue
            reply = read_reply(self._protocol, held[:size], one.judgement)
            heard = Heard(reply, self._times[0], self._times[size - 1], passed)
            if not reply.reason:
                right, paused = heard, False
            damaged = damaged or heard
        return right or damaged, is_open

    def _unasked(self) -> tuple[Heard | None, bool]:
        """The first answer where no request is heard, and whether it may be incomplete."""
        size = reply_size(self._protocol, bytes(self._held), None)
        if size is None or size > len(self._held):
            return None, True
        return (self._until(size, None) if size > 0 else None), False

    def _until(self, size: int, asked: Judgement | None) -> Heard:
        """So many bytes as one answer to a request; None for no request."""
        reply = read_reply(self._protocol, bytes(self._held[:size]), asked)
        return Heard(reply, self._times[0], self._times[size - 1], loose=asked is None)

    def _before(self, begun: int, waiting: Sequence[Waiting], answers: object) -> Heard:
        """What stands before a right answer: a right one that nobody asked for, or a damaged one.

        At 0 it is the first itself, which nobody asked for.
        """
        size = reply_size(self._protocol, bytes(self._held[: begun or None]), None) or 0
        unasked = self._until(size, None) if 0 < size <= (begun or size) else None
        if unasked and not unasked.reply.reason:
            return unasked
        return self._until(begun, waiting[0].judgement if waiting and answers else None)

    def _right_place(self, waiting: Iterable[Waiting], end: int, *, checked: bool) -> int | None:
        """The first place before `end` at which a right answer begins; None if that is not known.

        With `checked` only a check tells it, otherwise a sync too. At the first byte only an answer
        to an instruction that does not wait is looked for.
        """
        layout = self._protocol.reply
        if layout.check is None and (checked or not layout.sync):
            return None
        unasked = layout.check and (layout.sync or layout.check.part.size > 1)
        asked = [one.judgement for one in islice(waiting, _LOOKED_AT)]
        known = repeated_id(self._protocol, bytes(self._held))
        if not checked and unasked and asked and known and self._begins(0, [None]):
            return 0
        still: list[int] = []
        for at in range(1, end) if checked else [*self._open, *range(self._looked, end)]:
            if b"" not in self._starts and bytes(self._held[at : at + 1]) not in self._starts:
                continue
            begins = self._begins(at, [*asked, None] if unasked else asked)
            if begins:
                return at
            if begins is None:
                still.append(at)
        if not checked:
            self._looked, self._open = end, still
        return None

    def _begins(self, at: int, asked: Iterable[Judgement | None]) -> bool | None:
        """Whether a right answer to one of these requests begins there; None: not known yet."""
        data, is_open = bytes(self._held[at:]), False
        for one in asked:
            size = reply_size(self._protocol, data, one)
            if size is None or size > len(data):
                is_open = True
            elif size > 0:
                reply = read_reply(self._protocol, data[:size], one)
                if reply.response and not reply.reason:
                    return True
        return None if is_open else False

    def take_rest(self, *, alone: bool = False) -> Heard | None:
        """Take all that is held as one answer, mostly a damaged one; None if nothing is held.

        With `alone` no requests are heard.
        """
        if not self._held:
            return None
        reply = read_reply(self._protocol, bytes(self._held), None, alone=alone)
        if reply.reason:  # a right one ends by itself
            reply = replace(reply, open_end=True)
        return self._taken(Heard(reply, self._times[0], self._times[-1]))

    def _taken(self, heard: Heard) -> Heard:
        size = len(heard.reply.frame)
        del self._held[:size], self._times[:size]
        self._looked, self._open = 1, []
        return heard
