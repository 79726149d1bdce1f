"""The first bytes of a run: look before any byte, a setting, then the link check.

They tell a device that conforms or not from a line that cannot be used at all: nobody there, an
echo. The first byte is no Stop, because that would hide a robot that moves at power-on.
"""

from __future__ import annotations

from dataclasses import replace

from conformance.asks import Heard, Script, listen, power_cycle, see, send
from conformance.cases import Accepted, Case
from conformance.judging import NOT_OBSERVABLE, answer_words, judge_answers, judge_state, look_words
from conformance.run import Run
from conformance.setup import moves, setting
from conformance.verdicts import Axis, Verdict
from spec.codec import judge
from spec.motion import State

_STOPPED = "stopped"


def first_bytes(run: Run) -> Script[str]:
    """Run and report the first cases. Returns why the line cannot be used, "" if it can."""
    at_rest = run.special(
        "power-on/at-rest",
        run.protocol.clauses.safety,
        "stands still before the first byte",
        b"",
        "R-power-on",
    )
    run.begin(at_rest.id)
    axes = {"state": (yield from _still(run, at_rest.expected, "R-power-on"))}
    banner = yield from listen(None, 0)
    if banner.answers:
        words = answer_words(run.protocol, banner.codes)
        reason = "bytes came before the first instruction"
        axes["answer"] = Axis(Verdict.INFORMATIONAL, "no answer", words, reason, "R-unsolicited")
    outcomes = [(at_rest, axes, banner, banner.now)]
    for case in _steps(run):
        run.begin(case.id)
        first = len(outcomes) == 1
        heard, sent = yield from _exchange(run, case, run.limits.boot if first else 0)
        run.profile.measured(heard, sent)
        axes = {"answer": judge_answers(run.protocol, case.accepted, heard, sent, timed=True)}
        if first:
            axes["state"] = yield from _still(run, case.expected, "")
        outcomes.append((case, axes, heard, sent))
    unusable = _line_fault(run, [(case.stimulus, heard) for case, _, heard, _ in outcomes[1:]])
    if not unusable:
        for case, axes, heard, sent in outcomes:
            run.end(case, axes, heard.answers, sent)
        yield from _second_power_on(run)
    return unusable


def _second_power_on(run: Run) -> Script[None]:
    """Once more from power-on, this time with a motion first; skipped without a power switch."""
    spec = next((s for s in run.protocol.instructions if moves(s) and not s.length), None)
    if spec is None:
        return
    frame = bytes([run.protocol.header_bytes[spec.id, 0]])
    judgement = judge(run.protocol, frame)
    expected = spec.effect.apply(run.protocol.power_on)
    case = run.special(
        f"power-on/{spec.name}",
        judgement.clause,
        "a motion as the first instruction is taken; no speed is set yet, so nothing moves",
        frame,
        "R-power-on",
    )
    case = replace(case, accepted=(Accepted((judgement.response.code,)),), expected=expected)
    if not run.power:
        reason = "the robot cannot be switched off and on; see --power"
        run.end(case, {"answer": Axis(Verdict.SKIPPED, "", "not run", reason)})
        return
    run.begin(case.id)
    yield from power_cycle()
    heard, sent = yield from _exchange(run, case, run.limits.boot)
    axes = {
        "answer": judge_answers(run.protocol, case.accepted, heard, sent, timed=True),
        "state": (yield from _still(run, expected, "R-power-on", may_move=True)),
    }
    run.end(case, axes, heard.answers, sent)


def _steps(run: Run) -> tuple[Case, ...]:
    """A setting (must not move), an unused ID, and a setting without its data."""
    protocol = run.protocol
    low, high = protocol.limits.get("speed", (0, 0))
    speed = setting(protocol, "speed", (low + high) // 2) or bytes([protocol.filler])
    judged = judge(protocol, speed)
    steps = [(speed, f"power-on/{judged.name}", "a setting does not move the robot")]
    if protocol.unused_ids:
        unused = bytes([protocol.header_bytes[protocol.unused_ids[0], 0]])
        steps.append((unused, "link/unused-id", "an unused ID is refused"))
    if judged.length:
        short = bytes([protocol.header_bytes[judged.id, 0]])
        steps.append((short, "link/too-few", "missing data are refused"))
    cases = []
    for frame, ident, requirement in steps:
        judgement = judge(protocol, frame)
        after = protocol.power_on
        if judgement.valid and judgement.instruction:
            after = judgement.instruction.effect.apply(after, dict(judgement.fields))
        case = run.special(ident, judgement.clause, requirement, frame)
        accepted = (Accepted((judgement.response.code,)),)
        cases.append(replace(case, accepted=accepted, expected=after))
    return tuple(cases)


def _exchange(run: Run, case: Case, boot: int) -> Script[tuple[Heard, int]]:
    """Send and hear all that comes back; a board that boots is asked again for `boot` ns."""
    sent = yield from send(case.stimulus)
    heard = yield from run.answers(1)
    waited = run.limits.longest
    while not heard.answers and waited < boot:
        sent = yield from send(case.stimulus)
        heard = yield from run.answers(1)
        waited += run.limits.longest
    more = yield from listen(None, run.limits.silence)
    return Heard(heard.answers + more.answers, more.now), sent


def _line_fault(run: Run, exchanges: list[tuple[bytes, Heard]]) -> str:
    if not any(heard.answers for _, heard in exchanges):
        return (
            f"nobody answered in {run.limits.boot / 1e9:.0f} s: check power, wiring (TX to RX, "
            "common ground), the port and --baud"
        )
    if all(heard.codes == tuple(frame) for frame, heard in exchanges):
        return (
            "the line is an echo, every byte came back unchanged: a loop-back plug, or TX and RX "
            "wired together"
        )
    return ""


def _still(run: Run, expected: State, reading: str, *, may_move: bool = False) -> Script[Axis]:
    """The robot stands still; what else the probe tells is compared with `expected`.

    `may_move` where a motion was set: then it moves only if it has a speed from power-on.
    """
    if not run.looks_freely:
        return run.blind(_STOPPED)
    seen = yield from see()
    words = look_words(seen.look)
    if seen.look.moving is None:
        return Axis(Verdict.INCONCLUSIVE, _STOPPED, words, NOT_OBSERVABLE, reading)
    if seen.look.moving and may_move:
        reason = "has a speed from power-on"
        return Axis(Verdict.INFORMATIONAL, _STOPPED, words, reason, reading)
    if seen.look.moving:
        reason = "moves although no instruction has set a motion"
        return Axis(Verdict.FAIL, _STOPPED, words, reason, reading)
    axis = judge_state(expected, expected, seen.look, "set")
    if axis.verdict is Verdict.FAIL and reading:
        # The document does not say what speed or light a robot starts with.
        return Axis(Verdict.INFORMATIONAL, axis.expected, axis.actual, axis.reason, reading)
    return axis
