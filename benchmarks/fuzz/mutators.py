"""Damages inputs: bytes, text by its words, JSON by its tree. All randomness is given."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import cache, lru_cache
from random import Random
from typing import Any

from benchmarks.fuzz.engine import Mutate

_NUMBERS = (0, 1, 16, 255, 1 << 16, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 62)
_LONGEST = 1 << 16  # bytes of an input
_SHORT = 1 << 9  # bytes of one of which every byte is much work
_HOW_MANY = (1, 1, 1, 1, 1, 2, 2, 3, 5, 9)
_LENGTHS = (1, 1, 2, 3, 4, 8, 9, 16, 64)

HOSTILE = (
    *("", " ", "\0", "\n", "\r\n", "\x1b[31m", "\u202e", "\u2028", "\ufeff", "\ud800"),
    *("\U0010ffff", "é", "\xb2", "٣", "[/x]", "%s", "{0}", "=1+1", "../", "~", "-", "--"),
    *("a" * 300, "'" * 3, "nan", "inf", "-inf", "1e999", "-0", "1_0", "0x", "0b2", "08"),
    *("1e-400", "9" * 30, "9" * 5000),
)
"""Texts that readers stumble over."""


def _number(random: Random) -> int:
    return random.choice(_NUMBERS) + random.randint(-1, 1)


def change(random: Random, items: Any, others: Any, news: Callable[[], Any]) -> None:
    """Make one change in bytes or a list: a part goes, comes again or moves, or a new one comes.

    `others` are those of another input, `news` gives pieces that are in none.
    """
    at, count = random.randrange(len(items) + 1), random.choice(_LENGTHS)
    kind = random.randrange(6)
    if kind == 0:
        del items[at : at + count]
    elif kind == 1:
        items[at:at] = items[at : at + count] * random.choice((1, 1, 2, 40))
    elif kind == 2:
        start = random.randrange(len(others) + 1)
        part = others[start : start + count]
        items[at : at + random.choice((0, len(part)))] = part
    elif kind == 3 and items:
        other = random.randrange(len(items))
        at = min(at, len(items) - 1)
        items[at], items[other] = items[other], items[at]
    else:
        new = news()
        items[at : at + random.choice((0, len(new)))] = new


def mutated_bytes(random: Random, pool: Sequence[bytes]) -> bytes:
    """A short input with some bytes and numbers flipped, removed, repeated and inserted."""
    return damaged(random, random.choice(pool), pool)[:_SHORT]


def damaged(
    random: Random, data: bytes, pool: Sequence[bytes], words: Sequence[bytes] = ()
) -> bytes:
    """Some bytes with one to nine changes; parts of others in the pool may get into them."""
    changed = bytearray(data)

    def new() -> bytes:
        number = (_number(random) % (1 << 64)).to_bytes(8, "little")[: random.choice((1, 2, 4, 8))]
        return random.choice((number, random.randbytes(random.choice(_LENGTHS))))

    for _ in range(random.choice(_HOW_MANY)):
        if changed and random.random() < 0.2:
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
        elif words and random.random() < 0.2:
            at = random.randrange(len(changed) + 1)
            changed[at:at] = random.choice(words)
        else:
            change(random, changed, random.choice(pool), new)
    return bytes(changed[:_LONGEST])


_TOKEN = re.compile(r"[^\W\d]\w*|\d+(?:\.\d+)?|\s+|.", re.DOTALL)


@lru_cache(4096)
def _tokens(data: bytes) -> tuple[str, ...]:
    return tuple(_TOKEN.findall(data.decode("utf-8", "surrogateescape")))


def text_mutator(words: Callable[[], Sequence[str]]) -> Mutate:
    """Replaces, repeats, removes and moves the words of a text; new ones may be `words`.

    Those may depend on the grammar, which is read for the first input.
    """
    known = cache(lambda: (*words(), *words(), *HOSTILE))

    def mutate(random: Random, pool: Sequence[bytes]) -> bytes:
        tokens = list(_tokens(random.choice(pool)))
        for _ in range(random.choice(_HOW_MANY)):
            change(
                random,
                tokens,
                _tokens(random.choice(pool)),
                lambda: [random.choice((random.choice(known()), str(_number(random))))],
            )
        data = "".join(tokens).encode("utf-8", "surrogatepass")[:_LONGEST]
        return damaged(random, data, pool) if random.random() < 0.1 else data

    return mutate


_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 255, 256, 0.5, -0.0, 1e308, 1 << 31, 1 << 63, 1 << 64),
    *(-(1 << 70), float("nan"), float("inf"), [], {}, [[]], [None], {"": None}, *HOSTILE),
)


def json_mutator(words: Sequence[str]) -> Mutate:
    """Replaces, removes and adds values in the tree of a JSON text, also its words."""
    by_words = text_mutator(lambda: words)
    values = (*_VALUES, *words)

    def mutate(random: Random, pool: Sequence[bytes]) -> bytes:
        try:
            tree, donor = (json.loads(random.choice(pool)) for _ in range(2))
            for _ in range(random.choice(_HOW_MANY)):
                value = random.choice(values) if random.random() < 0.7 else _part(random, donor)
                tree = _changed_tree(random, tree, deepcopy(value))
            text = json.dumps(tree, ensure_ascii=random.random() < 0.5)
        except (ValueError, RecursionError):
            text = ""
        if not text or random.random() < 0.25:
            return by_words(random, pool)
        return text.encode("utf-8", "surrogatepass")[:_LONGEST]

    return mutate


def _part(random: Random, tree: Any) -> Any:
    """A value somewhere in a tree."""
    while isinstance(tree, dict | list) and tree and random.random() < 0.8:
        tree = random.choice(list(tree.values() if isinstance(tree, dict) else tree))
    return tree


def _changed_tree(random: Random, tree: Any, new: Any) -> Any:
    """The tree with one change at a random place: a value goes, comes or is another."""
    if not isinstance(tree, dict | list) or not tree or random.random() < 0.1:
        if type(tree) in (int, float) and random.random() < 0.5:
            return random.choice((-tree, tree + 1, tree * 10**9, str(tree)))
        if isinstance(tree, str) and random.random() < 0.5:
            at = random.randrange(len(tree) + 1)
            return f"{tree[:at]}{new}{tree[at:]}"
        return new
    below: Any = tree
    key = random.choice(list(below) if isinstance(below, dict) else range(len(below)))
    kind = random.random()
    if kind < 0.1:
        del below[key]
    elif kind < 0.2 and isinstance(below, list):
        below.insert(key, new)
    elif kind < 0.2:
        below[str(new)] = below[key]
    else:
        below[key] = _changed_tree(random, below[key], new)
    return below
