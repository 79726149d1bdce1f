"""The levels of the suite: which cases and sequences each of them holds, and what it promises.

smoke: some of everything in a few seconds. standard: every single frame and every pair, in every
way of delivery. deep: every truncation of every frame, and almost four times as many tours.
complete: what standard holds, and the words that prove the byte machine (`proof`). Of these cases
globs of ids select. Also: what cases cover, of how much there is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import chain, combinations, islice
from math import ceil
from typing import NamedTuple, TypeAlias

from bilprov.conformance.cases import contexts, sweeps
from bilprov.conformance.cases.case import OF_THE_RUN, Case, state_after, wheel_orders
from bilprov.conformance.cases.combinations import (
    ARRAY,
    DELIVERED,
    PIPELINED,
    RANDOM,
    SPLIT,
    STRENGTH,
    WAITED,
    Combinations,
    Row,
    random_sequences,
    space_of,
    total,
)
from bilprov.conformance.cases.proof import GROUP, PROOFS, Proof, proof_sequences
from bilprov.conformance.cases.sequence import DELIVERIES, Burst, SequenceCase
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.cases.steps import FrameClass, Step, kind_of, one_of_each
from bilprov.conformance.cases.tours import Tours
from bilprov.spec.by_effect import moving_motions
from bilprov.spec.motion import visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State

# -- the options of a run, as a report and a recording hold them ----------------------------------


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run; times are in milliseconds, None for the grammar's or the kit's own.

    `only` are globs of case ids in which * crosses /; none means all. `seed` governs how data and
    motions rotate through the cases. `strict` counts non-strict as failed, `fail_fast` ends the run
    after the first failure. `deadline` is how soon an answer is due: what is later is slow, what is
    later than the grammar's longest fails. `silence` is how long the line is listened to after an
    answer, `truncation_timeout` the pause that ends a frame (measured if None). `level` names the
    suite's level, `soak` how many faults more are sent at its end. `allow` are the choices
    (NAME=VALUE) that would fail otherwise. `profile` is the text of a device's profile, "" for
    none. `extra` is how many states more than the Protocol's machine a device may have that the
    level `complete` still finds. `first` are the ids of cases that are run before the others.
    """

    only: tuple[str, ...] = ()
    seed: int = 1
    strict: bool = False
    fail_fast: bool = False
    deadline: float | None = None
    silence: float | None = None
    truncation_timeout: float | None = None
    level: str = "standard"
    soak: int = 0
    allow: tuple[str, ...] = ()
    profile: str = ""
    extra: int = 0
    first: tuple[str, ...] = ()


AnyCase = Case | SequenceCase

_SOAKED = 1000  # faults of a soak for each random sequence in it


@dataclass(frozen=True, slots=True)
class Level:
    """A level of the suite; `GENERATORS` say how many sequences it holds."""

    name: str
    promise: str
    cuts: int  # truncations in a tour that holds some
    cut_each: int  # of how many tours one holds some
    singles: str  # `few`, `headers` (one truncation of each) or `all` (every truncation)
    idle: int  # ms for which a moving robot is sent nothing


SMOKE = Level("smoke", "a sample of everything", cuts=0, cut_each=1, singles="few", idle=300)
STANDARD = Level(
    "standard", "every frame and pair", cuts=1, cut_each=16, singles="headers", idle=1200
)
DEEP = Level("deep", "every cut", cuts=2, cut_each=2, singles="all", idle=5000)
COMPLETE = replace(STANDARD, name="complete", promise="standard and a proof")
LEVELS = {level.name: level for level in (SMOKE, STANDARD, DEEP, COMPLETE)}


@dataclass(frozen=True, slots=True)
class Source:
    """What the sequences of one level are made from; the tours remember what they have covered.

    `extra` is how many states more than the machine a device may have that is found by a proof.
    """

    protocol: Protocol
    level: Level
    seed: int
    tours: Tours
    extra: int

    def cut(self, number: int) -> bool:
        """Whether the tour of this number holds truncations."""
        return number % self.level.cut_each == 0


Make: TypeAlias = Callable[[Source, int], Iterable[SequenceCase]]


class Generator(NamedTuple):
    """A generator of sequences: its group, with which their ids begin, and how they are made.

    `amounts` are how many sequences, or faults, each level of `LEVELS` holds of it, as many as
    `standard` where there is none for it; a level with 0 leaves it out. `make` gets that amount.
    """

    group: str
    amounts: tuple[int, ...]
    make: Make

    def amount(self, level: Level) -> int:
        """How many a level holds."""
        amounts = dict(zip(LEVELS, self.amounts, strict=False))
        return amounts.get(level.name, amounts[STANDARD.name])


def _numbered(make: Callable[[Source, int], SequenceCase]) -> Make:
    """Make as many sequences as a level holds, one for each number from 1."""
    return lambda source, amount: (make(source, number) for number in range(1, amount + 1))


def _combined(word: str) -> Make:
    """Make the sequences of an array of combinations."""
    return lambda of, _: Combinations(of.protocol, of.seed, word).sequences()


def _in_context(make: Callable[[Protocol, int, int], Iterator[SequenceCase]]) -> Make:
    """Make the sequences of frames in context, as many turns of them as a level holds."""
    return lambda of, turns: make(of.protocol, of.seed, turns)


def _proving(proof: Proof) -> Make:
    """Make the sequences of a proof."""
    return lambda of, _: proof_sequences(of.protocol, proof, of.seed, of.extra)


RANDOM_GROUP = f"{ARRAY}/{RANDOM}"
"""The random sequences, of which a soak has more than its level."""


# In the order in which the sequences run. What a tour covers depends on the tours before it.
GENERATORS = (
    Generator("pipelined/dense", (0, 1, 1), lambda of, _: [sweeps.dense(of.protocol)]),
    Generator(
        "sequence/tour",
        (12, 130, 500),
        _numbered(lambda of, n: of.tours.waited("tour", n, cuts=of.level.cuts * of.cut(n))),
    ),
    Generator(
        contexts.ALONE,
        (1, 1, 10),
        lambda of, n: islice(
            contexts.left_alone(of.protocol, of.seed, n), 1 if of.level.singles == "few" else None
        ),
    ),
    Generator(
        "pipelined/tour",
        (4, 40, 150),
        _numbered(lambda of, n: of.tours.pipelined("tour", n, 24, (2, 6), cut=of.cut(n))),
    ),
    Generator(
        "pipelined/long",
        (1, 3, 10),
        _numbered(lambda of, n: of.tours.pipelined("long", n, 4, (30, 60), cut=True)),
    ),
    Generator("split/tour", (2, 8, 40), _numbered(lambda of, n: of.tours.split("tour", n, 30))),
    Generator("sequence/data", (0, 1, 1), lambda of, _: sweeps.data_sweep(of.protocol)),
    Generator("sequence/bad-data", (0, 1, 1), lambda of, _: sweeps.bad_data_sweep(of.protocol)),
    Generator("sequence/headers", (0, 1, 1), lambda of, _: sweeps.header_sweep(of.protocol)),
    Generator(
        "sequence/faults-in-a-row",
        (30, 300, 1100),
        lambda of, count: [sweeps.faults_in_a_row(of.protocol, of.seed, count)],
    ),
    Generator(
        "sequence/faults-alone",
        (30, 300, 1100),
        lambda of, count: [sweeps.faults_alone(of.protocol, of.seed, count)],
    ),
    Generator(
        "sequence/again", (0, 1, 1), lambda of, _: sweeps.again_and_again(of.protocol, of.seed)
    ),
    *(Generator(f"{ARRAY}/{word}", (0, 1, 1), _combined(word)) for word in DELIVERED),
    Generator(contexts.AFTER, (0, 1, 5), _in_context(contexts.after_each_kind)),
    Generator(contexts.CUT, (0, 1, 10), _in_context(contexts.truncations)),
    Generator(
        RANDOM_GROUP,
        (0, 20, 200),
        lambda of, amount: islice(random_sequences(of.protocol, of.seed), amount),
    ),
    *(Generator(f"{GROUP}/{one.name}", (0, 0, 0, 1), _proving(one)) for one in PROOFS),
)

INDEPENDENT_GROUPS = (
    *(f"{ARRAY}/{word}" for word in (*DELIVERED, RANDOM)),
    contexts.AFTER,
    contexts.CUT,
    *(f"{GROUP}/{one.name}" for one in PROOFS),
)
"""The groups of sequences that do not depend on others, and take long to make."""

SEQUENCE_PREFIXES = tuple(dict.fromkeys(f"{row.group.partition('/')[0]}/" for row in GENERATORS))
"""What the id of a sequence begins with."""


@lru_cache(maxsize=8)
def level_cases(
    protocol: Protocol,
    name: str,
    seed: int,
    soaked: int = 0,
    extra: int = 0,
    left_out: frozenset[str] = frozenset(),
) -> tuple[AnyCase, ...]:
    """All cases of a level, in the order in which they run.

    `soaked` is how many faults more to send at the end, with a random sequence for every
    `_SOAKED` of them, `extra` how many states more than the
    machine the level `complete` allows a device. `left_out` are groups of `INDEPENDENT_GROUPS`
    that are not made. Raises UserError where `extra` takes too many sequences.
    """
    level = LEVELS[name]
    # The random sequences of a soak go on after those of the level.
    held = next(row.amount(level) for row in GENERATORS if row.group == RANDOM_GROUP)
    return (
        *single_cases(protocol, name, seed),
        *_sequences(protocol, level, seed, extra, left_out),
        *sweeps.soak(protocol, seed, soaked),
        *islice(random_sequences(protocol, seed, held + 1), ceil(soaked / _SOAKED)),
    )


@lru_cache(maxsize=8)
def single_cases(protocol: Protocol, name: str, seed: int) -> tuple[Case, ...]:
    """The cases of a level that are no sequences: they come first, and are soon made.

    The wheels' order comes first: a wrong one explains what the cases after it see.
    """
    level = LEVELS[name]
    singles = all_cases(protocol, seed, every_cut=level.singles == "all")
    return tuple(_few(singles)) if level.singles == "few" else (*wheel_orders(protocol), *singles)


def _few(singles: Sequence[Case]) -> Iterator[Case]:
    """One case of each class of faults, and one of each instruction."""
    met: set[str] = set()
    for case in singles:
        first, *rest = case.id.split("/")
        name = "/".join((first, *rest[:1])) if case.kind is FrameClass.VALID else first
        if case.kind is not FrameClass.RECOVERY and name not in met:
            met.add(name)
            yield case


def _sequences(
    protocol: Protocol, level: Level, seed: int, extra: int, left_out: frozenset[str]
) -> Iterator[SequenceCase]:
    source = Source(protocol, level, seed, Tours(protocol, seed), extra)
    for generator in GENERATORS:
        amount = generator.amount(level)
        if amount and generator.group not in left_out:
            yield from generator.make(source, amount)


CONDITIONAL_CASES = (
    *OF_THE_RUN,
    "reading/version",
    "reading/led-id",
    "reading/led-upper-bits",
)
"""Cases that a run has only where they fail, or where an option asks for them."""

_WILD = re.compile(r"[*?[]")


LONGEST_GLOB = 1000
"""Characters of a glob; no id is as long, and the work of a glob grows with its square."""


def matching(globs: Iterable[str]) -> Callable[[str], bool]:
    """A predicate: whether an id matches one of the globs, in which * crosses /.

    It is fast for thousands of ids.
    """
    words = tuple(globs)
    exact = frozenset(words)
    wild = tuple(word for word in words if _WILD.search(word))
    return lambda ident: ident in exact or any(fnmatchcase(ident, glob) for glob in wild)


def reaches(globs: Iterable[str], prefixes: Iterable[str]) -> bool:
    """Whether one of the globs may match an id that begins with one of the prefixes."""
    heads = [_WILD.split(glob, maxsplit=1)[0] for glob in globs]
    return any(p.startswith(head) or head.startswith(p) for p in prefixes for head in heads)


# -- coverage: which frames, pairs, states and deliveries cases exercise, of how many -------------
# Coverage is counted in facts; a fact is a pair (what is counted, the item). A sequence's facts
# come from the model with the kit's own readings. The totals leave out what cannot be reached (no
# motion goes on after a stop).


Fact = tuple[str, object]

HEADERS = "headers"
VALID = "valid frames"
BAD = "bad data"
CUTS = "truncations"
STATES = "instructions and faults x kinds of motion"
PAIRS = "pairs in a row"
TRIPLES = "pairs in a row x kinds of motion"
WAYS = "instructions and faults x deliveries"
COMBINED = {2: "combinations of two", STRENGTH: "combinations of three"}


def facts(protocol: Protocol, case: AnyCase) -> Iterator[Fact]:
    """The facts that a case exercises."""
    if isinstance(case, SequenceCase):
        yield from _run(protocol, case)
        return
    yield from _sent(case, kind_of(protocol, case))
    yield from _met(kind_of(protocol, case), visible_motion(case.setup), "waited")


def _sent(step: Step, kind: str) -> Iterator[Fact]:
    """The facts of a frame by itself."""
    yield HEADERS, step.frame[0]
    if step.truncated:
        yield CUTS, (step.frame[0], len(step.frame) - 1)
    elif not step.faulty:
        yield VALID, step.frame
    elif kind == FrameClass.BAD_DATA:
        yield BAD, step.frame


def _met(kind: str, motion: str, way: str) -> Iterator[Fact]:
    """The facts of a kind of frame in a motion and a delivery."""
    yield STATES, (kind, motion)
    if kind != FrameClass.TRUNCATED and way != "cut":
        yield WAYS, (kind, way)


def _run(protocol: Protocol, sequence: SequenceCase) -> Iterator[Fact]:
    sent: dict[bytes, tuple[Step, str]] = {}
    met: set[tuple[str, str, str, str]] = set()
    last = ""
    for place, (burst, _, step, state, _) in enumerate(_walk(protocol, sequence)):
        kind = kind_of(protocol, step)
        if place >= len(sequence.setup):
            sent[step.frame] = step, kind
            met.add((last, kind, visible_motion(state), burst.delivery))
        last = kind
    for step, kind in sent.values():
        yield from _sent(step, kind)
    for before, kind, motion, way in met:
        yield from _met(kind, motion, way)
        if before:
            yield PAIRS, (before, kind)
            yield TRIPLES, (before, kind, motion)


def _walk(
    protocol: Protocol, sequence: SequenceCase
) -> Iterator[tuple[Burst, int, Step, State, Step | None]]:
    """Each step with its burst and how many of that follow it, the state and the step before it."""
    state, before = protocol.power_on, None
    for burst in (*(Burst((step,)) for step in sequence.setup), *sequence.bursts):
        for left, step in zip(reversed(range(len(burst.steps))), burst.steps, strict=True):
            yield burst, left, step, state, before
            state, before = state_after(protocol, state, step), step


@lru_cache(maxsize=4)
def totals(protocol: Protocol) -> dict[str, int]:
    """How many facts of each kind there are."""
    lengths, specs = protocol.lengths, protocol.instructions
    motions = (protocol.car.still, *moving_motions(protocol))
    # Every protocol can truncate a frame, if only one with an unused ID.
    faults = len({FrameClass.TRUNCATED, *one_of_each(protocol)})
    kinds = len(specs) + faults
    # After a motion the robot moves so, or stands still (speed 0); a setting leaves any motion on.
    reached = (
        sum(
            2 if protocol.car.moves(s.effect) else 1 if protocol.stops(s.effect) else len(motions)
            for s in specs
        )
        + faults
    )
    return {
        HEADERS: len(protocol.headers),
        # These totals hold every value; where data are wide, a level sends only a sample of them.
        VALID: sum(spec.valid_count for spec in specs),
        BAD: sum(spec.bad_data_count for spec in specs),
        CUTS: sum(lengths),
        STATES: kinds * len(motions),
        PAIRS: kinds * kinds,
        TRIPLES: reached * kinds,
        # A truncated frame has one delivery: its end cannot come in pieces or be waited for.
        WAYS: (kinds - 1) * len(DELIVERIES),
    }


def covered(protocol: Protocol, cases: Iterable[AnyCase]) -> dict[str, tuple[int, int]]:
    """How many facts these cases exercise, out of how many: (done, of) by what is counted."""
    cases, of = list(cases), totals(protocol)
    met: set[Fact] = set()
    for case in cases:
        met.update(facts(protocol, case))
    done = Counter(name for name, _ in met)
    found = {name: (done[name], of[name]) for name in of if of[name]}
    combined = [
        case for case in cases if isinstance(case, SequenceCase) and case.id.startswith(f"{ARRAY}/")
    ]
    return found | _combinations(protocol, combined) if combined else found


def _combinations(protocol: Protocol, cases: Iterable[SequenceCase]) -> dict[str, tuple[int, int]]:
    """How many combinations of two and of three factors these cases exercise, out of how many.

    Of each burst the last frame counts, after which the robot is observed; truncated frames do not.
    """
    met: dict[int, set[tuple[int, ...]]] = {strength: set() for strength in COMBINED}
    of = {strength: total(protocol, strength) for strength in COMBINED}
    seen: set[Row] = set()
    for row in _rows(protocol, cases):
        if all(len(met[strength]) == of[strength] for strength in COMBINED):
            break
        if row in seen:
            continue
        seen.add(row)
        for strength, found in met.items():
            if len(found) < of[strength]:
                # A number stands for a factor and its value.
                values = [factor << 16 | value for factor, value in enumerate(row)]
                found.update(combinations(values, strength))
    return {name: (len(met[strength]), of[strength]) for strength, name in COMBINED.items()}


def _rows(protocol: Protocol, cases: Iterable[SequenceCase]) -> Iterator[Row]:
    """The rows of the frames after which these cases observe the robot."""
    space = space_of(protocol)
    for burst, left, step, state, before in chain.from_iterable(_walk(protocol, c) for c in cases):
        if burst.looks and not left and not step.truncated:
            way = SPLIT if burst.pauses else PIPELINED if len(burst.steps) > 1 else WAITED
            fault = kind_of(protocol, before) if before and before.faulty else ""
            row = space.row(state, fault, step, way)
            if row:
                yield row
