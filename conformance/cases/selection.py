"""Selects the cases of a run by globs of their ids. Pure."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase

from bilprov.conformance.cases.case import OF_THE_RUN

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
