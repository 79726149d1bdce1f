"""Minimises a failed sequence to a short one that still fails, and writes its reproducer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

from bilprov.analyzer.client.operations import Procedure
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.runner.attempt import Attempt
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.sequence_answers import Mismatch

LONGEST_MINIMISED, _SHORTER = 5, 60  # sequences minimised in a run, tries for each


def up_to(case: SequenceCase, mismatch: Mismatch) -> SequenceCase:
    """The sequence up to and including the burst of the mismatch."""
    return replace(case, bursts=case.bursts[: max(0, mismatch.burst) + 1])


def minimise(
    case: SequenceCase,
    first: Attempt,
    mismatch: Mismatch,
    retry: Callable[[SequenceCase], Procedure[Attempt]],
) -> Procedure[SequenceCase]:
    """The shortest sequence found that still fails on the same axis, by the attempts of `retry`.

    Bursts are left out, first many at a time, then single frames of the rest. The preamble stays:
    the state it sets differs from the one after power-on. A sequence that failed in its preamble
    becomes the preamble's steps up to the failure.
    """
    last = mismatch.burst
    if last < 0:
        begun = case.setup[: len(case.setup) + last + 1]
        return replace(case, setup=(), bursts=tuple(Burst((step,)) for step in begun))
    best = replace(case, bursts=case.bursts[: last + 1])
    size, left = max(1, len(best.bursts) // 2), _SHORTER
    while left > 0:
        for shorter in (*_without_bursts(best, size), *(_without_steps(best) if size == 1 else ())):
            left -= 1
            tried = yield from retry(shorter)
            end = tried.mismatch.burst + 1 if tried.mismatch else len(shorter.bursts)
            if tried.failed and end > 0 and tried.axis == first.axis:
                best = replace(shorter, bursts=shorter.bursts[:end])
                size = max(1, min(size, len(best.bursts) // 2))
                break
            if left <= 0:
                break
        else:
            if size == 1:
                break
            size //= 2
    return best


def _without_bursts(sequence: SequenceCase, size: int) -> Iterator[SequenceCase]:
    """The sequence without each run of `size` consecutive bursts, the last ones first."""
    for end in range(len(sequence.bursts), 0, -size):
        left = sequence.bursts[: max(0, end - size)] + sequence.bursts[end:]
        if left:
            yield replace(sequence, bursts=left)


def _without_steps(sequence: SequenceCase) -> Iterator[SequenceCase]:
    """The sequence without each one frame of its longer bursts; their pauses may go with it."""
    for at, burst in enumerate(sequence.bursts):
        for index in range(len(burst.steps) if len(burst.steps) > 1 else 0):
            steps = burst.steps[:index] + burst.steps[index + 1 :]
            pauses = burst.pauses if index == len(burst.steps) - 1 else ()
            fewer = replace(burst, steps=steps, pauses=pauses)
            yield replace(
                sequence, bursts=(*sequence.bursts[:at], fewer, *sequence.bursts[at + 1 :])
            )


def reproducer(run: Run, case: SequenceCase) -> str:
    """The arguments of `bilprov send` that repeat the sequence: bytes, and pauses where needed."""
    bursts = (*(Burst((step,)) for step in case.setup), *case.bursts)
    words: list[str] = []
    split = any(burst.pauses for burst in bursts)
    gap = max(1, run.waiting.timeout // 16_000_000)
    for burst in bursts:
        data = burst.data
        places = [0, *(p for p in burst.pauses if p < len(data)), len(data)]
        for start, end in pairwise(places):
            words += [f"pause={gap}"] if start else []
            words.append(data[start:end].hex())
        if split and burst is not bursts[-1]:
            words.append(f"pause={run.waiting.usual // 1_000_000}")
    return " ".join((["--together"] if split else []) + words)
