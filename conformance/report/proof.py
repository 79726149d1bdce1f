"""What a run of the level `complete` has proven of a device, and on which assumptions it rests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bilprov.captures.text import quantity
from bilprov.conformance.cases.levels import COMPLETE, Options
from bilprov.conformance.cases.proof import GROUP, PROOFS, Proof, sequences, silence, suite
from bilprov.conformance.oracle.profile import Figures
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import STATE_POINTS


def proven(
    protocol: Protocol,
    results: Sequence[CaseResult],
    options: Options,
    profile: Figures,
) -> str:
    """A paragraph on what the results prove, "" for another level than `complete`."""
    if options.level != COMPLETE.name:
        return ""
    extra = options.extra
    shown, missing = [], []
    for proof in PROOFS:
        if not proof.applies(protocol):
            continue
        why = _missing(protocol, proof, extra, results, profile)
        if why:
            missing.append(f"Nothing is proven by {proof.seen(protocol)}: {why}.")
        else:
            shown.append(_machine(protocol, proof, extra))
    if shown:
        shown = [
            "Proven: the device does in every state what the Protocol requires, as far as is "
            "seen by " + "; by ".join(shown) + ".",
            *_assumptions(protocol),
        ]
    return " ".join([*shown, *missing])


def _machine(protocol: Protocol, proof: Proof, extra: int) -> str:
    """The machine of a proof, and among which devices it is the only one that passes."""
    bytes_, told = proof.machine(protocol), suite(protocol, proof, extra)
    states = len(bytes_.machine)
    return (
        f"{proof.seen(protocol)} ({quantity(states, 'state')}, {len(bytes_.classes)} classes of "
        f"bytes and the silence, {quantity(len(told.words), 'word')}): every other device of at "
        f"most {states + extra} states would have failed"
    )


def _assumptions(protocol: Protocol) -> Iterator[str]:
    yield (
        "Assumed: the device treats all bytes of one class alike, speeds above zero among them "
        "(each class took all its values in turn, but not each value in each state)."
    )
    yield (
        "Time has two classes: pauses inside a frame, waiting for answers and observations, far "
        f"below its time-out, and a silence longer than that (between frames {silence(protocol)} "
        "ms)."
    )
    yield (
        f"The reset before each word, {quantity(protocol.longest_frame, protocol.stop.name)} and "
        "the settings that the first state needs, leads there from every state (its answers and "
        "what is seen after it were judged)."
    )
    yield "What the robot does inside a frame was not observed."


def _missing(
    protocol: Protocol,
    proof: Proof,
    extra: int,
    results: Sequence[CaseResult],
    profile: Figures,
) -> str:
    """Why a proof does not hold, "" if it does."""
    unseen = [facet for facet in proof.facets(protocol) if facet not in (profile.facets or ())]
    if unseen:
        return f"no probe reported the robot's {' and '.join(unseen)}"
    others = [p for p in profile.other_readings if proof.looks or p not in STATE_POINTS]
    if others:
        return (
            "the device reads the document differently from the machine "
            f"({', '.join(others)}), so its sequences were a test but not a proof"
        )
    usual, timeout = profile.all_but_two_answers_ms, profile.truncation_timeout_ms
    if usual and timeout and 2 * usual >= timeout:
        return (
            f"answers take up to {usual:g} ms and the time-out is {timeout:g} ms, so a frame "
            "that the device took for a longer one may have passed"
        )
    if timeout and timeout >= silence(protocol):
        return (
            f"the time-out is {timeout:g} ms, and the silences between frames last "
            f"{silence(protocol)} ms"
        )
    own = [r for r in results if r.id.startswith(f"{GROUP}/{proof.name}/")]
    if not own:
        return "none of its sequences was run"
    of = sequences(protocol, proof, extra)
    good = sum(_passed(proof, result) for result in own)
    return "" if good == of else f"{good} of its {quantity(of, 'sequence')} were run and passed"


def _passed(proof: Proof, result: CaseResult) -> bool:
    """Whether a sequence was judged to its end and nothing deviated in what the proof sees."""
    if not proof.looks:
        answer = result.axes.get("answer")
        worse = result.verdict > Verdict.INCONCLUSIVE
        return not worse and answer is not None and answer.verdict is Verdict.PASS
    return result.verdict is Verdict.PASS
