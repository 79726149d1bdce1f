"""What is odd about a frame, an answer or a line event, how bad it is, and why, in words.

Severities follow the readings of the document: error is what a device that conforms never does,
warning what a host does wrong or a reading leaves open, info what only makes things uncertain.
"""

from __future__ import annotations

from typing import NamedTuple

from analyzer.decode.pairing import MILLISECOND, Held, Pair, Waiting
from analyzer.decode.records import Fault, Severity
from captures.errors import shown
from captures.schemas import Line
from spec.codec import Judgement, spaced
from spec.legal_answers import other_choices
from spec.protocol import Protocol

MID_FRAME = "out of step: the device answered in mid-frame"
UNCLEAR = "came before it was clear where frames begin"
LOST = "bytes were lost in mid-frame"

# Line events that are faults by themselves; the others (open, close, modem) are only noted.
LINE_SEVERITY = {
    "gap": Severity.WARNING,
    "overrun": Severity.WARNING,
    "reconnected": Severity.INFO,
    "break": Severity.WARNING,
    "parity": Severity.WARNING,
    "framing": Severity.WARNING,
    "unplugged": Severity.ERROR,
}


class Why(NamedTuple):
    """Why a device byte belongs to no instruction; with an empty `kind` that is no fault."""

    kind: str
    severity: Severity
    reason: str


class Verdict(NamedTuple):
    """Whether an answer is as expected (None: nothing is expected), and what is odd about it."""

    agrees: bool | None
    faults: tuple[Fault, ...]


ALONE = Why("", Severity.INFO, "")
OUT_OF_STEP = Why("out of step", Severity.INFO, "answers a frame whose beginning was not seen")
_EARLY = Why("unsolicited", Severity.INFO, "no instruction was seen yet that it could answer")
_NEAR_LOSS = Why("unsolicited", Severity.INFO, "may answer an instruction around the lost bytes")
_UNSOLICITED = Why("unsolicited", Severity.ERROR, "no instruction waits for an answer")


def of_frame(judgement: Judgement, known: int, sequence: int) -> tuple[Fault, ...]:
    """What is odd about a host frame, known since `known` (ns): that it is not valid."""
    if judgement.valid:
        return ()
    kind = "truncated" if judgement.truncated else "faulty instruction"
    return (Fault(known, kind, Severity.WARNING, judgement.reason, sequence),)


def of_garbage(known: int, reason: str) -> tuple[Fault, ...]:
    """Host bytes that belong to no frame are odd."""
    return (Fault(known, "garbage", Severity.WARNING, reason),)


def of_answer(protocol: Protocol, pair: Pair, skew: int) -> Verdict:
    """What is odd about an answer, given the instruction that it answers.

    `skew` (ns) is how far two taps may stamp an answer before its instruction.
    """
    held, waiting = pair.held, pair.waiting
    expected = waiting.judgement.response
    agrees = held.byte == expected.code
    found = []
    if held.byte not in protocol.codes:
        found.append(_unused_code(protocol, held.byte))
    elif not agrees:
        found.append(_disagreeing(protocol, held, waiting))
    latency = held.t - waiting.end
    late = protocol.timing.answer_deadline
    # How long a device takes to give up on a frame is its own choice (R-truncation-timeout).
    if latency > late * MILLISECOND and not waiting.judgement.truncated:
        reason = f"answered after {latency / MILLISECOND:.1f} ms, {late:g} ms is the deadline"
        found.append(Why("slow", Severity.WARNING, reason))
    elif latency < 0:
        reason = f"stamped {-latency / MILLISECOND:.1f} ms before the instruction was complete"
        severity = Severity.INFO if -latency <= skew else Severity.WARNING
        found.append(Why("early", severity, reason))
    faults = tuple(Fault(held.t, *why, waiting.sequence) for why in found)
    return Verdict(agrees, faults)


def of_unpaired(protocol: Protocol, held: Held, why: Why) -> Verdict:
    """What is odd about a device byte that answers nothing."""
    found = [why] if why.kind else []
    unused = held.byte not in protocol.codes
    if unused:
        found.append(_unused_code(protocol, held.byte))
    return Verdict(False if unused else None, tuple(Fault(held.t, *one) for one in found))


def unsolicited_because(instructions: int, near_loss: bool) -> Why:
    """Why an answer is unsolicited, after so many instructions, soon after a loss or not."""
    if near_loss:
        return _NEAR_LOSS
    return _UNSOLICITED if instructions else _EARLY  # R-unsolicited: a banner


def unanswered(waiting: Waiting, now: int) -> Fault:
    """An instruction that got no answer, known at `now` (ns)."""
    judgement = waiting.judgement
    # R-truncated-known: a device may stop without an answer.
    severity = Severity.WARNING if judgement.truncated else Severity.ERROR
    reason = (
        f"no answer to instruction {waiting.sequence}, {judgement.describe()} "
        f"({spaced(judgement.frame)}), in {(now - waiting.end) / MILLISECOND:.0f} ms"
    )
    return Fault(now, "unanswered", severity, reason, waiting.sequence)


def of_line(line: Line, lost: bool) -> tuple[Fault, ...]:
    """What is odd about a line event; `lost` where bytes are missing after it."""
    severity = LINE_SEVERITY.get(line.event)
    if severity is None:
        return ()
    where = f" on the {line.tap} line" if line.tap else ""
    reason = shown(line.detail) if line.detail else f"{line.event}{where}"
    return (Fault(line.t, "lost bytes" if lost else line.event, severity, reason),)


def _unused_code(protocol: Protocol, byte: int) -> Why:
    used = ", ".join(str(code) for code in protocol.codes)
    return Why("unused code", Severity.ERROR, f"{byte} is an unused response, used are {used}")


def _disagreeing(protocol: Protocol, held: Held, waiting: Waiting) -> Why:
    """The device's word against the grammar's; some readings allow another word for a fault."""
    judgement, said = waiting.judgement, protocol.codes[held.byte]
    because = f": {judgement.reason}" if judgement.reason else ", it is valid"
    choices = {choice.code: choice.reading for choice in other_choices(protocol, judgement)}
    rests_on = choices.get(held.byte) or judgement.reading
    reading = f" ({rests_on})" if rests_on else ""
    return Why(
        "disagreeing",
        Severity.WARNING if held.byte in choices else Severity.ERROR,
        f"the device says {said.name} to {judgement.describe()}, expected is "
        f"{judgement.response.name}{because}{reading}",
    )
