"""Selects the cases of a run: by globs of their ids, and by its shard. Pure."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase

from bilprov.conformance.cases.levels import AnyCase

CONDITIONAL_CASES = (
    "line/probe",
    "line/unsolicited",
    "line/lost",
    "line/pipelining",
    "power-on/lost",
    "power-on/first-fault",
    "motion/settings",
    "leave/stopped",
    "level/left-out",
    "reading/version",
    "reading/led-id",
    "reading/led-upper-bits",
)
"""Cases that a run has only where they fail, or where an option asks for them."""

_WILD = re.compile(r"[*?[]")
_SHARD = re.compile(r"([1-9][0-9]{0,5})/([1-9][0-9]{0,5})")


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


def shard_named(text: str) -> tuple[int, int]:
    """The shard that `I/N` names: I from 1 to N. Raises ValueError, in one sentence."""
    found = _SHARD.fullmatch(text)
    index, count = (int(number) for number in found.groups()) if found else (0, 0)
    if not 1 <= index <= count:
        raise ValueError(
            f"{text!r} is not a shard; write I/N, the I-th of N shares, I from 1 to N, such as 1/4"
        )
    return index, count


def share(
    cases: Sequence[AnyCase], shard: tuple[int, int], seconds: Callable[[AnyCase], float]
) -> tuple[AnyCase, ...]:
    """The cases of shard (I, N), in their order; each case is in exactly one of the N shards.

    `seconds` estimates how long a case takes: the longest cases are dealt out first, each to the
    shard that has least to do, so that all take about as long. Raises ValueError for an I that is
    not from 1 to N.
    """
    index, count = shard
    if not 1 <= index <= count:
        raise ValueError(f"there is no shard {index} of {count}; the first is 1, the last {count}")
    dear = sorted(enumerate(seconds(case) for case in cases), key=lambda pair: (-pair[1], pair[0]))
    loads = [(0.0, number) for number in range(1, count + 1)]
    mine = []
    for at, cost in dear:
        load, number = loads[0]
        heapq.heapreplace(loads, (load + cost, number))
        if number == index:
            mine.append(at)
    return tuple(cases[at] for at in sorted(mine))
