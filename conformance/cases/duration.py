"""How long cases take, by arithmetic: bytes on the wire, the silences they wait for, the looks."""

from __future__ import annotations

from conformance.cases.levels import AnyCase
from conformance.cases.sequence import Walk
from conformance.cases.steps import Class
from conformance.oracle.judge import MS
from conformance.oracle.timers import Limits
from spec.protocol import Protocol

_EXCHANGE = 0.0004  # s for an answer and a look, on a local line


def seconds(protocol: Protocol, case: AnyCase, byte_time: float, timeout: float) -> float:
    """About how long (s) a case takes; `byte_time` and `timeout` (a frame's pause) are in s."""
    limits = Limits()
    home = 4 * protocol.longest_frame * byte_time
    silence = limits.silence / MS / 1000
    if isinstance(case, Walk):
        size = sum(len(data) + 1 for data in case.sent)
        bursts = len(case.bursts) + len(case.setup)
        total = home + size * byte_time + bursts * _EXCHANGE
        for burst in case.bursts:
            total += 1.25 * timeout if burst.steps[-1].cut else 0.0
            total += burst.dwell / 1000 + len(burst.pauses) * min(timeout / 8, 0.004)
        return total
    total = home + (12 + len(case.stimulus)) * byte_time + 8 * _EXCHANGE
    if case.stop:
        total += limits.hold / MS / 1000 if case.thorough else silence
    if case.kind in (Class.BAD_DATA, Class.TRUNCATED) and not case.thorough:
        total -= silence * 3 / 4
    return total + (1.1 * timeout if case.arrived is not None or case.short else 0.0)


def answers_in(case: AnyCase) -> int:
    """How many times a case waits for an answer before it goes on, homing included."""
    if isinstance(case, Walk):
        return len(case.setup) + len(case.bursts) + 2
    return 9


def before_the_cases(timeout: float) -> float:
    """About how long (s) the opening and the probes of a run take."""
    return 2.5 + 8 * timeout
