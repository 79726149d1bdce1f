"""Feeds a target with damaged inputs, watches its work, and shortens those that it fails on.

A target fails on an input by any exception but those it may refuse it with, by a wrong result, by
more than CPU_SECONDS of computing, or by more memory than MEMORY.
"""

from __future__ import annotations

import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from random import Random
from types import FrameType
from typing import TypeVar

CORPUS = Path(__file__).parent / "corpus"
CPU_SECONDS = 5.0  # for one input
MEMORY = 1 << 30  # bytes of address space for all inputs of a target, above what is in use before
_POOL = 400  # inputs to begin from: the seeds, and those with an outcome that was new
_SHORT = 4096  # bytes of an input of the corpus that is damaged again
_OUTCOMES = 20_000  # that are told apart
_kept: list[tempfile.TemporaryDirectory[str]] = []
_REFUSED_KEPT = 0.1  # of the inputs that are refused in a new way
_TRIES = 1_500  # to shorten a finding
_SHORTENING = 20.0  # s for that
_SOURCES = ("/spec/", "/captures/", "/analyzer/", "/conformance/")

Outcome = TypeVar("Outcome")
Test = Callable[[bytes], Hashable]
Mutate = Callable[[Random, Sequence[bytes]], bytes]


class Wrong(Exception):
    """Raised by a target for a wrong result: two ways that must agree differ, or a broken file."""


def require(fine: bool, what: str) -> None:
    """Raise Wrong unless the result is fine."""
    if not fine:
        raise Wrong(what)


class Endless(BaseException):
    """Raised inside of a target that computes for too long; no `except Exception` sees it."""


@dataclass(frozen=True, slots=True)
class Target:
    """One way in for foreign bytes.

    `prepare` makes its test: a function of one input that returns what it came to (anything by
    which inputs can be told apart) or raises one of `refuses`. `seeds` are good inputs, from which
    `mutate` makes damaged ones. `share` is its share of all inputs, beside those of the others.
    """

    name: str
    prepare: Callable[[], Test]
    refuses: tuple[type[Exception], ...]
    seeds: Callable[[], list[bytes]]
    mutate: Mutate
    share: float

    @property
    def holds(self) -> str:
        """What must hold of every input."""
        return (self.prepare.__doc__ or "").strip()

    def pool(self) -> list[bytes]:
        """Its seeds, and the short ones of the inputs that it once failed on."""
        past = [path.read_bytes() for path in corpus(self.name)]
        return [*self.seeds(), *(data for data in past if len(data) <= _SHORT)]


def corpus(name: str) -> list[Path]:
    """The files of the corpus for a target: inputs that it once failed on."""
    return sorted(path for path in (CORPUS / name).glob("*") if path.is_file())


@cache
def folder() -> Path:
    """A folder for the files of this process, which is removed with it."""
    memory = Path("/dev/shm")  # what is written is also synced to its disk
    parent = memory if memory.is_dir() else None
    kept = tempfile.TemporaryDirectory(prefix="bilprov-fuzz-", dir=parent)
    _kept.append(kept)
    return Path(kept.name)


@dataclass(frozen=True, slots=True)
class Failure:
    """How a target fails: the exception, and where it came from; one of these is one finding."""

    error: str
    where: str


@dataclass(slots=True)
class Finding:
    """Inputs of a target that fail alike: the shortest one known, what it says, and how many."""

    target: str
    failure: Failure
    data: bytes
    said: str
    times: int = 1


@dataclass(slots=True)
class Row:
    """The result for one target: how many inputs, how many of them failed; `seconds` of computing.

    `refused` are how many it refused in the way it may, `outcomes` how many could be told apart.
    """

    target: str
    inputs: int = 0
    crashes: int = 0
    seconds: float = 0.0
    refused: int = 0
    outcomes: int = 0
    findings: list[Finding] = field(default_factory=list)


def run(
    target: Target, inputs: int, seed: int, progress: Callable[[int], object] = lambda count: None
) -> Row:
    """Feed a target with damaged inputs; the same seed gives the same ones.

    An input with an outcome that was not met before is damaged further: so the inputs get as far
    as the target lets them. `progress` is told how many more are done.
    """
    random = Random(f"{seed} {target.name}")
    row = Row(target.name)
    found: dict[Failure, Finding] = {}
    outcomes: set[Hashable] = set()
    begun = time.process_time()
    with watched():
        test, pool = target.prepare(), target.pool()
        told = 0
        for number in range(1, inputs + 1):
            data = target.mutate(random, pool)
            outcome = outcome_of(target, test, data)
            if isinstance(outcome, Failed):
                row.crashes += 1
                _note(found, target, data, outcome)
            elif outcome not in outcomes and len(outcomes) < _OUTCOMES:
                outcomes.add(outcome)
                # Else what is refused in thousands of ways would crowd out what is taken.
                if type(outcome) is not Refused or random.random() < _REFUSED_KEPT:
                    _keep(pool, data, random)
            row.refused += type(outcome) is Refused
            if number % 256 == 0 or number == inputs:
                progress(number - told)
                told = number
        row.inputs, row.outcomes = inputs, len(outcomes)
        for finding in found.values():
            finding.data = shortened(target, test, finding)
    row.findings = list(found.values())
    row.seconds = time.process_time() - begun
    return row


def _note(found: dict[Failure, Finding], target: Target, data: bytes, failed: Failed) -> None:
    known = found.get(failed.failure)
    if known is None:
        found[failed.failure] = Finding(target.name, failed.failure, data, failed.said)
        return
    known.times += 1
    if len(data) < len(known.data):
        known.data, known.said = data, failed.said


def _keep(pool: list[bytes], data: bytes, random: Random) -> None:
    if len(pool) < _POOL:
        pool.append(data)
    else:
        pool[random.randrange(_POOL)] = data


@dataclass(frozen=True, slots=True)
class Refused:
    """An input was refused, as it should be: by this exception, with these words."""

    error: str
    words: str


@dataclass(frozen=True, slots=True)
class Failed:
    """An input was neither taken nor refused; `said` is the whole traceback's end."""

    failure: Failure
    said: str


def outcome_of(target: Target, test: Test, data: bytes) -> Hashable:
    """What comes of one input: what the test returns, or a Refused, or a Failed."""
    return guarded(lambda: test(data), target.refuses)


def guarded(
    act: Callable[[], Outcome], refuses: tuple[type[Exception], ...] = ()
) -> Outcome | Refused | Failed:
    """What an act returns, or a Refused, or a Failed; only within `watched` is it bounded."""
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    try:
        return act()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        signal.setitimer(signal.ITIMER_PROF, 0)
        if isinstance(error, refuses) and not isinstance(error, UnicodeError):
            return Refused(type(error).__name__, _words(str(error)))
        return Failed(_failure(error), _said(error))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


# What differs between two sentences that say the same: numbers, and what is quoted.
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"|\b0x[0-9a-f]+|\d+")


def _words(text: str) -> str:
    return _QUOTED.sub("", text[:400])[:80]


def _failure(error: BaseException) -> Failure:
    """The failure of an exception, by the last place in the product that it passed."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if any(part in frame.filename for part in _SOURCES)]
    last = (ours or frames)[-1]
    if isinstance(error, Endless | RecursionError | MemoryError):  # it may end anywhere
        first = (ours or frames)[0]
        return Failure(type(error).__name__, Path(first.filename).name)
    what = _words(str(error)) if isinstance(error, Wrong) else ""
    name = type(error).__name__ + (f": {what}" if what else "")
    return Failure(name, f"{Path(last.filename).name}:{last.lineno}")


def _said(error: BaseException) -> str:
    return "".join(traceback.format_exception(error, limit=-6))[-3000:]


@contextmanager
def watched() -> Iterator[None]:
    """Bound computing and memory meanwhile; a warning is an error."""

    def over(number: int, frame: FrameType | None) -> None:
        raise Endless(f"more than {CPU_SECONDS:g} s of computing")

    before = signal.signal(signal.SIGPROF, over)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = _address_space() + MEMORY
    if hard == resource.RLIM_INFINITY or most < hard:
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _address_space() -> int:
    """How many bytes of address space this process has; much where nobody tells."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:
        return 4 << 30
    return pages * resource.getpagesize()


def shortened(target: Target, test: Test, finding: Finding) -> bytes:
    """A shorter input that fails alike: parts are left out, larger ones first, then made plain."""
    data, tries = finding.data, _TRIES
    until = time.monotonic() + _SHORTENING

    def fails(other: bytes) -> bool:
        nonlocal tries
        tries -= 1
        outcome = outcome_of(target, test, other)
        return isinstance(outcome, Failed) and outcome.failure == finding.failure

    size = len(data) // 2
    while size and tries > 0 and time.monotonic() < until:
        at = 0
        while at < len(data) and tries > 0 and time.monotonic() < until:
            other = data[:at] + data[at + size :]
            if fails(other):
                data = other
            else:
                at += size
        size //= 2
    for at in range(len(data)):
        if tries <= 0 or time.monotonic() > until:
            break
        other = data[:at] + b"0" + data[at + 1 :]
        if other != data and fails(other):
            data = other
    return data
