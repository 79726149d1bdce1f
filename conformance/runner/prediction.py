"""Prediction: tries a case again where a fitted rhythm says that it fails; held twice it is proven.

Noise does not come where it is predicted. A case is brought to its place by harmless frames of the
kind that the rhythm counts.
"""

from __future__ import annotations

from bilprov.analyzer.client.operations import Procedure, listen, send
from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.runner.attempt import Attempt, attempt
from bilprov.conformance.runner.homing import home
from bilprov.conformance.runner.noise import burst_bytes, is_no_noise
from bilprov.conformance.runner.rhythm import Rhythm, fit
from bilprov.conformance.runner.run import Run
from bilprov.conformance.runner.tally import VALID, Tally, counters

_HELD = 2  # predictions in a row that prove a rhythm, more of a burst that noise often spoils
_GUESSES = 3  # counters tried for one mismatch, each with its best period
_FACTORS = (2, 3, 5, 7)
_BATCH = 8  # frames sent ahead on the way to a place


def find_rhythm(run: Run, case: Case | SequenceCase, first: Attempt) -> Procedure[Rhythm | None]:
    """The rhythm of a failure that was not reproduced: fitted, predicted, and held twice.

    Leaves the line homed. Raises Ended and GaveUp as homing does.
    """
    tally = run.tally
    if first.cycles != tally.cycles:
        return None  # the frames are counted anew since then
    guesses = list(run.rhythms.proven)
    if not guesses and not run.rhythms.spent:
        run.rhythms.fits += 1
        guesses = fit(run.protocol, tally.sent, tally.places)[:_GUESSES]
    for guess in guesses:
        held, proven, size = 0, False, burst_bytes(case, first)
        while not proven and not run.rhythms.spent:
            if not (yield from _holds(run, case, first, guess)):
                break
            held += 1
            proven = held >= _HELD and is_no_noise(run, first, size, held, held)
        if proven:
            if guess in run.rhythms.proven:
                return guess
            shortest = yield from _shortest(run, case, first, guess)
            run.rhythms.proven.append(shortest)
            return shortest
    return None


def _shortest(
    run: Run, case: Case | SequenceCase, first: Attempt, rhythm: Rhythm
) -> Procedure[Rhythm]:
    """The rhythm, or the shortest that it is a multiple of and at whose places it fails as well."""
    for factor in _FACTORS:
        while rhythm.period % factor == 0 and rhythm.period > factor and not run.rhythms.spent:
            shorter = rhythm._replace(period=rhythm.period // factor)
            after = shorter.period
            if not (yield from _holds(run, case, first, rhythm, after=after)):
                break
            rhythm = shorter
    return rhythm


def _holds(
    run: Run,
    case: Case | SequenceCase,
    first: Attempt,
    rhythm: Rhythm,
    after: int = 0,
) -> Procedure[bool]:
    """Attempt a case a whole number of periods, and `after` frames, later: whether it fails so."""
    tally = run.tally
    reached = yield from _go_to(run, rhythm, first.started, after)
    if not reached:
        return False
    run.rhythms.attempts += 1
    again = yield from attempt(run, case)
    if again.stopped:
        raise again.stopped
    return again.failed and again.where == first.where and tally.cycles == first.cycles


def _go_to(run: Run, rhythm: Rhythm, started: int, after: int) -> Procedure[bool]:
    """Send harmless frames until the counter stands as it did at `started`, by the period.

    Returns whether it stands so.
    """
    tally, pad = run.tally, bytes([run.protocol.pad_byte])
    frame = _example(run, rhythm.counter)
    if not frame:
        return False
    if frame != pad:
        yield from _send_until(run, rhythm, started, after, frame)
        yield from home(run)
    else:
        yield from home(run)
        yield from _send_until(run, rhythm, started, after, frame)
    return _left(tally, rhythm, started, after) == 0


def _left(tally: Tally, rhythm: Rhythm, started: int, after: int) -> int:
    """How many frames of the counter are missing to the place."""
    wanted = tally.count(rhythm.counter, started) + after
    return (wanted - tally.count(rhythm.counter)) % rhythm.period


def _send_until(
    run: Run, rhythm: Rhythm, started: int, after: int, frame: bytes
) -> Procedure[None]:
    left = _left(run.tally, rhythm, started, after)
    run.rhythms.frames += left
    most = _BATCH if run.keeps_all and not run.profile.one_by_one else 1
    while left > 0:
        batch = min(most, left)
        yield from send(frame * batch)
        # What is due here may be missing or come twice: that is what is looked for.
        yield from run.waiting.all_answers(batch, run.waiting.usual)
        left -= batch
    yield from listen(None, run.timers.settle)


def _example(run: Run, counter: str) -> bytes:
    """A complete frame that the counter counts, a valid one if it can be, b"" where none was sent.

    It is the Stop of homing where this is counted.
    """
    counted = {
        frame: outcome
        for sent, frame in run.tally.examples.items()
        if counter in (outcome := counters(run.protocol, sent))
    }
    valid = (frame for frame, outcome in counted.items() if VALID in outcome)
    pad = bytes([run.protocol.pad_byte])
    return pad if pad in counted else next(valid, next(iter(counted), b""))
