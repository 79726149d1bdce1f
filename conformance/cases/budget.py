"""Estimates how long cases take, and selects those that add the most coverage within a budget.

An estimate counts bytes on the wire, silences, time-outs and looks. Also: what a run of cases makes
the robot do, and how fast at most, which is told before it begins.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.case import OrderCase, full_state
from bilprov.conformance.cases.levels import SEQUENCE_PREFIXES, AnyCase, Fact, facts
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.single_frames import motion_first
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.oracle.profile import Timers
from bilprov.spec.by_effect import Movement, frames_to, link_check, movement_of, movers
from bilprov.spec.protocol import Protocol

PAUSE = 2 * MS  # the longest inside a frame
_LOOKS = 3  # at each setting of the wheels' order
_LOOKS_ONCE, _LOOKS_AT_STOP, _LOOKS_AT_RECOVERY = 2, 5, 3  # in a case of a single frame
_ANSWERS_BEFORE, _LOOKS_BEFORE = 190, 60  # that are waited for before the first case
_WATCHED_BEFORE = 1.8  # s for which a probe watches the robot before the first case
_ANSWERS = 9  # in a case of a single frame, with its homing
_PAUSES = 2  # after a fault in a case of a single frame, for a setting and a motion
_RETRIED = 10  # answers that a failed case waits for in vain where it is tried again
_EXCHANGE = 0.0004  # s for an answer and a look, on a local line
_LOCAL_LOOK = 0.001  # s that a look takes at most there


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a line, a device and a probe are, for an estimate; times in s.

    `timeout` is the pause that ends a truncated frame, `byte_time` that of a byte on the wire,
    `answer` how long the line or the device holds an answer back, `look` how long a look takes.
    With `few_looks` at most the thorough cases are looked at.
    """

    timeout: float
    byte_time: float = 0.0
    answer: float = 0.0
    look: float = 0.0
    few_looks: bool = False

    @property
    def slow_look(self) -> float:
        """By how much a look takes longer than one on a local line."""
        return max(0.0, self.look - _LOCAL_LOOK)


def within(
    protocol: Protocol,
    cases: Sequence[AnyCase],
    budget: float,
    seconds: Callable[[AnyCase], float],
) -> tuple[AnyCase, ...]:
    """The cases that fit into `budget` s and together exercise the most, in the order given.

    First one of each group is chosen, the cheapest groups first. The next case is always the one
    that adds the most `facts` per second; cases that add none are chosen last, as long as there is
    time.
    """
    told = {case.id: frozenset(facts(protocol, case)) for case in cases}
    cost = {case.id: max(seconds(case), 1e-4) for case in cases}
    order = {case.id: index for index, case in enumerate(cases)}
    met: set[Fact] = set()
    chosen: set[str] = set()
    left = budget
    worth = {case.id: len(told[case.id]) / cost[case.id] for case in cases}
    best = {group(c.id): c.id for c in sorted(cases, key=lambda c: (worth[c.id], -order[c.id]))}
    for ident in sorted(best.values(), key=lambda ident: (cost[ident], order[ident])):
        if cost[ident] <= left:
            chosen.add(ident)
            met |= told[ident]
            left -= cost[ident]
    # A case adds fewer facts as others are chosen, never more: an old estimate is never too low.
    heap = [(-worth[c.id], order[c.id], c.id) for c in cases if c.id not in chosen]
    heapq.heapify(heap)
    while heap:
        _, index, ident = heapq.heappop(heap)
        adds = -len(told[ident] - met) / cost[ident]
        if heap and adds > heap[0][0]:
            heapq.heappush(heap, (adds, index, ident))
        elif cost[ident] <= left:
            chosen.add(ident)
            met |= told[ident]
            left -= cost[ident]
    return tuple(case for case in cases if case.id in chosen)


def group(ident: str) -> str:
    """The group that a case belongs to: the first part of its id, for sequences the first two."""
    parts = 2 if ident.startswith(SEQUENCE_PREFIXES) else 1
    return "/".join(ident.split("/")[:parts])


def seconds(protocol: Protocol, case: AnyCase, pace: Pace) -> float:
    """About how long (s) a case takes."""
    waits = waits_of(case, few=pace.few_looks)
    slow = waits.answers * pace.answer + waits.looks * pace.slow_look
    return _undelayed(protocol, case, pace.byte_time, pace.timeout) + slow


def _undelayed(protocol: Protocol, case: AnyCase, byte_time: float, timeout: float) -> float:
    timers = Timers()
    home = 4 * protocol.longest_frame * byte_time + timers.settle / MS / 1000
    if isinstance(case, SequenceCase):
        size = sum(len(data) + 1 for data in case.sent)
        bursts = len(case.bursts) + len(case.setup)
        total = home + size * byte_time + bursts * _EXCHANGE
        for burst in case.bursts:
            total += timeout if burst.steps[-1].truncated else 0.0
            total += burst.idle_ms / 1000 + len(burst.pauses) * min(timeout / 8, PAUSE / 1e9)
        return total
    if isinstance(case, OrderCase):
        size = sum(len(frame) + 1 for frame in case.sent)
        return home + size * byte_time + case.frames * (1 + _LOOKS) * _EXCHANGE
    # A stop is preceded by a motion, and followed by a setting and a motion.
    frames = 10 if case.stop else 4
    total = (2 * frames + len(case.frame)) * byte_time + frames * _EXCHANGE
    if case.stop:
        # One fault in eight waits for silence.
        share = 1 if case.thorough or case.kind is FrameClass.VALID else 8
        total += timers.silence / share / MS / 1000
    total += timers.settle / MS / 1000
    return total + (1.1 * timeout if case.truncated else 0.0)


class Waits(NamedTuple):
    """What a case waits for.

    `answers` come before it goes on, homing included, and `looks` outside silences, which last as
    long without them.
    """

    answers: int
    looks: int


def waits_of(case: AnyCase, *, few: bool = False) -> Waits:
    """What a case waits for; with `few` only a thorough one is looked at."""
    if isinstance(case, SequenceCase):
        looks = 0 if few else 1 + sum([burst.looks for burst in case.bursts])
        return Waits(len(case.setup) + len(case.bursts) + 2, looks)
    if isinstance(case, OrderCase):
        return Waits(case.frames + 2, 0 if few else _LOOKS * case.frames)
    looks = _LOOKS_AT_RECOVERY if case.then else _LOOKS_AT_STOP if case.stop else _LOOKS_ONCE
    return Waits(_ANSWERS, _LOOKS_ONCE * case.thorough if few else looks)


def faults_of(case: AnyCase) -> int:
    """How many faults a device gets a pause after that discards what follows them."""
    if isinstance(case, SequenceCase):
        return sum(any(step.faulty for step in burst.steps) for burst in case.bursts)
    return _PAUSES * case.faulty


def waits_in_vain(cases: Sequence[AnyCase], longest: float, retried: int) -> float:
    """About how long (s) the cases take more with a device that gives up no frame cut short.

    Each case with such a frame fails: it waits for answers that do not come, up to `longest` s for
    one, and the first `retried` of them are tried again and made shorter.
    """
    cut = sum(
        any(step.truncated for step in case.steps)
        if isinstance(case, SequenceCase)
        else case.truncated
        for case in cases
    )
    return longest * (cut + _RETRIED * min(cut, retried))


def before_the_cases(pace: Pace) -> float:
    """About how long (s) the opening cases and the probes of a run take."""
    watched = 0.0 if pace.few_looks else _WATCHED_BEFORE + _LOOKS_BEFORE * pace.slow_look
    return 0.7 + 8 * pace.timeout + _ANSWERS_BEFORE * pace.answer + watched


def run_movement(protocol: Protocol, cases: Sequence[AnyCase], *, looks: bool) -> Movement:
    """What the cases and the opening of their run make a conforming robot do.

    With `looks` the opening tries every kind of motion at the greatest speed, to see it move.
    """
    tested = chain.from_iterable(_frames(protocol, case) for case in cases)
    first = motion_first(protocol)
    opening = [*filter(None, link_check(protocol)), *(first.sent if first else ())]
    for spec in movers(protocol) if looks else ():
        opening += frames_to(protocol, full_state(protocol, spec))
    return movement_of(protocol, chain(opening, tested))


def _frames(protocol: Protocol, case: AnyCase) -> Iterator[bytes]:
    if isinstance(case, SequenceCase):
        yield from (step.frame for step in (*case.setup, *case.steps))
        return
    yield from frames_to(protocol, case.setup)
    yield from case.sent
