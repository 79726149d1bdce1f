"""Estimates how long cases take, from bytes on the wire, silences, time-outs and looks."""

from __future__ import annotations

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.levels import AnyCase
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.oracle.timers import Timers
from bilprov.spec.protocol import Protocol

_EXCHANGE = 0.0004  # s for an answer and a look, on a local line


def seconds(protocol: Protocol, case: AnyCase, byte_time: float, timeout: float) -> float:
    """About how long (s) a case takes.

    `byte_time` and `timeout` (the pause that ends a truncated frame) are in s.
    """
    timers = Timers()
    home = 4 * protocol.longest_frame * byte_time
    silence = timers.silence / MS / 1000
    if isinstance(case, SequenceCase):
        size = sum(len(data) + 1 for data in case.sent)
        bursts = len(case.bursts) + len(case.setup)
        total = home + size * byte_time + bursts * _EXCHANGE
        for burst in case.bursts:
            total += 1.25 * timeout if burst.steps[-1].truncated else 0.0
            total += burst.idle_ms / 1000 + len(burst.pauses) * min(timeout / 8, 0.004)
        return total
    total = home + (12 + len(case.frame)) * byte_time + 8 * _EXCHANGE
    if case.stop:
        total += timers.hold / MS / 1000 if case.thorough else silence
    if case.kind in (FrameClass.BAD_DATA, FrameClass.TRUNCATED) and not case.thorough:
        total -= silence * 3 / 4
    return total + (1.1 * timeout if case.truncated or case.short else 0.0)


def answers_in(case: AnyCase) -> int:
    """How many times a case waits for an answer before it goes on, homing included."""
    if isinstance(case, SequenceCase):
        return len(case.setup) + len(case.bursts) + 2
    return 9


def before_the_cases(timeout: float) -> float:
    """About how long (s) the opening cases and the probes of a run take; `timeout` is in s."""
    return 2.5 + 8 * timeout
