"""The cases that open every run, whatever else it holds: power-on, the link, the time-out.

As values, like all cases; `first_bytes` and `timeout` run them.
"""

from __future__ import annotations

from dataclasses import replace

from conformance.cases.preamble import moves, setting
from conformance.cases.single_frames import Case, special
from conformance.cases.steps import Accepted
from conformance.oracle.verdicts import Verdict
from spec.codec import judge
from spec.protocol import Protocol


def opening_cases(protocol: Protocol) -> tuple[Case, ...]:
    """All of them, in the order in which they run."""
    found = (at_rest(protocol), *link_check(protocol), motion_first(protocol))
    return tuple(case for case in (*found, truncation_timeout(protocol)) if case is not None)


def at_rest(protocol: Protocol) -> Case:
    """A look before any byte."""
    requirement = "stands still before the first byte"
    return special(
        protocol, "power-on/at-rest", protocol.clauses.safety, requirement, b"", "R-power-on"
    )


def link_check(protocol: Protocol, taken: int | None = None) -> tuple[Case, ...]:
    """A setting (must not move), an unused ID (not the one that is `taken`), and missing data."""
    low, high = protocol.limits.get("speed", (0, 0))
    speed = setting(protocol, "speed", (low + high) // 2) or bytes([protocol.filler])
    judged = judge(protocol, speed)
    cases = [_answered(protocol, f"power-on/{judged.name}", "a setting does not move it", speed)]
    free = [identity for identity in protocol.unused_ids if identity != taken]
    if free:
        unused = bytes([protocol.header_bytes[free[0], 0]])
        cases.append(_answered(protocol, "link/unused-id", "an unused ID is refused", unused))
    if judged.length:
        short = bytes([protocol.header_bytes[judged.id, 0]])
        cases.append(_answered(protocol, "link/too-few", "missing data are refused", short))
    return tuple(cases)


def motion_first(protocol: Protocol) -> Case | None:
    """A motion as the first instruction after power-on: a Stop there would hide what it does."""
    spec = next((s for s in protocol.instructions if moves(s) and not s.length), None)
    if spec is None:
        return None
    requirement = "a motion as the first instruction is taken; without a speed nothing moves"
    frame = bytes([protocol.header_bytes[spec.id, 0]])
    return _answered(protocol, f"power-on/{spec.name}", requirement, frame, "R-power-on")


def truncation_timeout(protocol: Protocol) -> Case | None:
    """A header whose data never come, with one long wait for its answer."""
    spec = next((s for s in protocol.instructions if s.length), None)
    if spec is None:
        return None
    frame = bytes([protocol.header_bytes[spec.id, spec.length]])
    requirement = f"a pause inside {spec.name} ends it and stops the robot"
    ident, reading = "timing/truncation-timeout", "R-truncation-timeout"
    case = _answered(protocol, ident, requirement, frame, reading)
    silent = Accepted((), Verdict.NON_STRICT, "R-truncated-known")
    return replace(case, accepted=(*case.accepted, silent))


def _answered(
    protocol: Protocol, ident: str, requirement: str, frame: bytes, reading: str = ""
) -> Case:
    """A frame with the answer and the state that it brings after power-on."""
    judgement = judge(protocol, frame)
    after = protocol.power_on
    if judgement.valid and judgement.instruction:
        after = judgement.instruction.effect.apply(after, dict(judgement.fields))
    case = special(protocol, ident, judgement.clause, requirement, frame, reading)
    accepted = (Accepted((judgement.response.code,)),)
    return replace(case, accepted=accepted, expected=after)
