"""The levels of the suite: which cases and sequences each of them holds, and what it promises.

smoke: some of everything in a few seconds. standard: every single frame and every pair, in every
way of delivery. deep: every truncation of every frame, and almost four times as many tours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

from bilprov.conformance.cases.case import Case
from bilprov.conformance.cases.sequence import SequenceCase
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.cases.sweeps import (
    bad_data_sweep,
    data_sweep,
    dense,
    faults_alone,
    faults_in_a_row,
    header_sweep,
    soak,
)
from bilprov.conformance.cases.tours import Tours
from bilprov.spec.protocol import Protocol

AnyCase = Case | SequenceCase

# How long (ms) the robot is sent nothing after each frame of a left-alone sequence.
_DWELLS = (65, 35, 130, 65, 35, 65, 140, 35, 65, 20, 130, 65)


@dataclass(frozen=True, slots=True)
class Level:
    """How much a level holds: sequences of each kind, truncations in a tour, faults in a row."""

    name: str
    promise: str
    tours: int
    pipelined: int
    long: int
    split: int
    cuts: int
    alone: int
    faults: int
    sweeps: bool
    singles: str  # `few`, `headers` (one truncation of each) or `all` (every truncation)
    idle: int  # ms for which a moving robot is sent nothing


SMOKE = Level(
    name="smoke",
    promise="a look at everything in about 5 s",
    tours=12,
    pipelined=4,
    long=1,
    split=2,
    cuts=0,
    alone=1,
    faults=30,
    sweeps=False,
    singles="few",
    idle=300,
)
STANDARD = Level(
    name="standard",
    promise="every single frame, every pair in every kind of motion, every way of delivery",
    tours=130,
    pipelined=40,
    long=3,
    split=10,
    cuts=1,
    alone=10,
    faults=300,
    sweeps=True,
    singles="headers",
    idle=1200,
)
DEEP = Level(
    name="deep",
    promise="every cut of every frame, almost four times the tours",
    tours=500,
    pipelined=150,
    long=10,
    split=40,
    cuts=2,
    alone=40,
    faults=1100,
    sweeps=True,
    singles="all",
    idle=5000,
)
LEVELS = {level.name: level for level in (SMOKE, STANDARD, DEEP)}


SEQUENCE_PREFIXES = ("sequence/", "pipelined/", "split/")
"""What the id of a sequence begins with."""


@lru_cache(maxsize=8)
def level_cases(protocol: Protocol, name: str, seed: int, soaked: int = 0) -> tuple[AnyCase, ...]:
    """All cases of a level, in the order in which they run.

    `soaked` is how many faults more to send at the end.
    """
    return (
        *single_cases(protocol, name, seed),
        *_sequences(protocol, LEVELS[name], seed),
        *(soak(protocol, seed, soaked) if soaked else ()),
    )


@lru_cache(maxsize=8)
def single_cases(protocol: Protocol, name: str, seed: int) -> tuple[Case, ...]:
    """The cases of a level that are no sequences: they come first, and are soon made."""
    level = LEVELS[name]
    singles = all_cases(protocol, seed, every_cut=level.singles == "all")
    return tuple(_few(singles)) if level.singles == "few" else singles


def _few(singles: Sequence[Case]) -> Iterator[Case]:
    """One case of each class of faults, and one of each instruction."""
    met: set[str] = set()
    for case in singles:
        first, *rest = case.id.split("/")
        name = "/".join((first, *rest[:1])) if case.kind is FrameClass.VALID else first
        if case.kind is not FrameClass.RECOVERY and name not in met:
            met.add(name)
            yield case


def _sequences(protocol: Protocol, level: Level, seed: int) -> Iterator[SequenceCase]:
    tours = Tours(protocol, seed)
    if level.sweeps:
        yield dense(protocol)
    for number in range(level.tours):
        yield tours.waited("tour", number + 1, cuts=level.cuts if number % 2 else 0)
    for number in range(level.alone):
        yield tours.left_alone("left-alone", number + 1, _DWELLS)
    for number in range(level.pipelined):
        yield tours.pipelined("tour", number + 1, 24, (2, 6))
    for number in range(level.long):
        yield tours.pipelined("long", number + 1, 4, (30, 60))
    for number in range(level.split):
        yield tours.split("tour", number + 1, 30)
    if level.sweeps:
        yield from data_sweep(protocol)
        yield from bad_data_sweep(protocol)
        yield from header_sweep(protocol)
    if level.faults:
        yield faults_in_a_row(protocol, seed, level.faults)
        yield faults_alone(protocol, seed, level.faults)
