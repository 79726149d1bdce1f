"""The cases that open every run: power-on, the link check, the truncation time-out.

They are values, like all cases; `runner.power_on` and `runner.truncation_timeout` run them.
"""

from __future__ import annotations

from dataclasses import replace

from bilprov.conformance.cases.case import Case, runner_case, state_after
from bilprov.conformance.cases.steps import kind_of, step_of
from bilprov.conformance.oracle.verdicts import Accepted, Verdict
from bilprov.spec.by_effect import link_check as frames_of_link_check
from bilprov.spec.protocol import Protocol


def opening_cases(protocol: Protocol) -> tuple[Case, ...]:
    """All opening cases, in the order in which they run."""
    found = (at_rest(protocol), *link_check(protocol), motion_first(protocol))
    return tuple(case for case in (*found, truncation_timeout(protocol)) if case is not None)


def at_rest(protocol: Protocol) -> Case:
    """The case that observes the robot before any byte is sent."""
    requirement = "stands still before the first byte"
    return runner_case(
        protocol, "power-on/at-rest", protocol.clauses.safety, requirement, b"", "R-power-on"
    )


def link_check(protocol: Protocol, taken: int | None = None) -> tuple[Case, ...]:
    """The cases that check the link: a setting, an unused ID, and missing data.

    The setting must not move the robot. `taken` is an unused ID to leave out.
    """
    setting, unused, short = frames_of_link_check(protocol, taken)
    name = kind_of(protocol, step_of(protocol, setting))
    cases = [_answered(protocol, f"power-on/{name}", "a setting does not move it", setting)]
    if unused:
        cases.append(_answered(protocol, "link/unused-id", "an unused ID is refused", unused))
    if short:
        cases.append(_answered(protocol, "link/too-few", "missing data are refused", short))
    return tuple(cases)


def motion_first(protocol: Protocol) -> Case | None:
    """The case of a motion as the first instruction after power-on: a Stop would hide its effect.

    None where every motion takes data.
    """
    spec = next(
        (s for s in protocol.instructions if protocol.car.moves(s.effect) and not s.length), None
    )
    if spec is None:
        return None
    requirement = "a motion as the first instruction is taken; without a speed nothing moves"
    frame = bytes([protocol.header_bytes[spec.id, 0]])
    return _answered(protocol, f"power-on/{spec.name}", requirement, frame, "R-power-on")


def truncation_timeout(protocol: Protocol) -> Case | None:
    """The case of a header whose data never come, with one long wait for its answer.

    None where no instruction takes data.
    """
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
    """A case of one frame, with the answer and the state that are due for it after power-on."""
    step = step_of(protocol, frame)
    case = runner_case(protocol, ident, step.clause, requirement, frame, reading)
    after = state_after(protocol, protocol.power_on, step)
    return replace(case, accepted=step.accepted[:1], expected=after)
