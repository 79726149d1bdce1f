"""Damages inputs: bytes, text by its words, JSON by its tree. All randomness is given."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import cache, lru_cache
from random import Random
from struct import pack
from typing import Any

from benchmarks.fuzz.engine import Mutate

_ENDS = (0, 1, 7, 8, 0x7F, 0x80, 0xFE, 0xFF)
_NUMBERS = (0, 1, 16, 255, 1 << 16, 1 << 24, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 62)
_LARGEST = (1 << 64) - 1
_LONGEST = 1 << 16  # bytes of an input
_SHORT = 1 << 9  # bytes of one of which every byte is much work
_HOW_MANY = (1, 1, 1, 1, 1, 2, 2, 3, 5, 9)

HOSTILE = (
    *(
        "",
        " ",
        "\0",
        "\n",
        "\r\n",
        "\x1b[31m",
        "\u202e",
        "\u2028",
        "\ufeff",
        "\ud800",
        "\U0010ffff",
    ),
    *("é", "\xb2", "٣", "[/x]", "%s", "{0}", "=1+1", "../", "~", "-", "--", "a" * 300, "'" * 3),
    *(
        "nan",
        "inf",
        "-inf",
        "1e999",
        "-0",
        "1_0",
        "0x",
        "0b2",
        "08",
        "1e-400",
        "9" * 30,
        "9" * 5000,
    ),
)
"""Texts that readers stumble over."""


def mutated_bytes(random: Random, pool: Sequence[bytes]) -> bytes:
    """A short input with some bytes and numbers flipped, removed, repeated and inserted."""
    return damaged(random, random.choice(pool), pool)[:_SHORT]


def damaged(
    random: Random, data: bytes, pool: Sequence[bytes], words: Sequence[bytes] = ()
) -> bytes:
    """Some bytes with one to nine changes; parts of others in the pool may get into them."""
    changed = bytearray(data)
    for _ in range(random.choice(_HOW_MANY)):
        _change(random, changed, pool, words)
    return bytes(changed[:_LONGEST])


def _change(random: Random, data: bytearray, pool: Sequence[bytes], words: Sequence[bytes]) -> None:
    size = len(data)
    at = random.randrange(size + 1)
    kind = random.randrange(9)
    if kind == 0 and at < size:
        data[at] ^= 1 << random.randrange(8)
    elif kind == 1 and at < size:
        data[at] = random.choice(_ENDS)
    elif kind == 2:
        del data[at : at + _length(random)]
    elif kind == 3:
        data[at:at] = random.randbytes(_length(random))
    elif kind == 4:
        data[at:at] = data[at : at + _length(random)] * random.choice((1, 1, 2, 40))
    elif kind == 5:
        other = random.choice(pool)
        start = random.randrange(len(other) + 1)
        part = other[start : start + _length(random) * 8]
        data[at : at + random.choice((0, len(part)))] = part
    elif kind == 6:
        number = random.choice(_NUMBERS) + random.randint(-1, 1)
        data[at : at + 8] = pack("<Q", number & _LARGEST)[: random.choice((2, 4, 8))]
    elif kind == 7 and words:
        word = random.choice(words)
        data[at : at + random.choice((0, len(word)))] = word
    elif at < size:
        data[at] = random.randrange(256)


def _length(random: Random) -> int:
    return random.choice((1, 1, 2, 3, 4, 8, 9, 16, 64))


_TOKEN = re.compile(r"[^\W\d]\w*|\d+(?:\.\d+)?|\s+|.", re.DOTALL)


@lru_cache(4096)
def _tokens(data: bytes) -> tuple[str, ...]:
    return tuple(_TOKEN.findall(data.decode("utf-8", "surrogateescape")))


def text_mutator(words: Sequence[str]) -> Mutate:
    """Replaces, repeats, removes and moves the words of a text; new ones may be `words`."""
    known = (*words, *words, *HOSTILE) if words else HOSTILE

    def mutate(random: Random, pool: Sequence[bytes]) -> bytes:
        tokens = list(_tokens(random.choice(pool)))
        for _ in range(random.choice(_HOW_MANY)):
            _change_words(random, tokens, pool, known)
        data = "".join(tokens).encode("utf-8", "surrogatepass")[:_LONGEST]
        return damaged(random, data, pool) if random.random() < 0.1 else data

    return mutate


def words_mutator(words: Callable[[], Sequence[str]]) -> Mutate:
    """A `text_mutator` whose words depend on the grammar, which is read for the first input."""
    made = cache(lambda: text_mutator(words()))
    return lambda random, pool: made()(random, pool)


def _change_words(
    random: Random, tokens: list[str], pool: Sequence[bytes], words: Sequence[str]
) -> None:
    size = len(tokens)
    at = random.randrange(size + 1)
    kind = random.randrange(8)
    if kind <= 1 and at < size:
        tokens[at] = random.choice(words)
    elif kind == 2:
        tokens.insert(at, random.choice(words))
    elif kind == 3:
        del tokens[at : at + random.choice((1, 1, 2, 4, 16))]
    elif kind == 4:
        tokens[at:at] = tokens[at : at + random.choice((1, 2, 5, 20))] * random.choice(
            (1, 1, 3, 60)
        )
    elif kind == 5:
        other = _tokens(random.choice(pool))
        start = random.randrange(len(other) + 1)
        part = other[start : start + random.choice((1, 2, 8, 30))]
        tokens[at : at + random.choice((0, len(part)))] = part
    elif kind == 6 and at < size and tokens[at].isdecimal():
        number = random.choice(_NUMBERS) + random.randint(-1, 1)
        tokens[at] = str(random.choice((number, -number, number / 7)))
    elif size > 1:
        other_place = random.randrange(size)
        at = min(at, size - 1)
        tokens[at], tokens[other_place] = tokens[other_place], tokens[at]


_VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        1,
        -1,
        255,
        256,
        0.5,
        -0.0,
        1e308,
        1 << 31,
        1 << 63,
        1 << 64,
        -(1 << 70),
    ),
    *(float("nan"), float("inf"), [], {}, [[]], [None], {"": None}, *HOSTILE),
)


def json_mutator(words: Sequence[str]) -> Mutate:
    """Replaces, removes, adds and moves values in the tree of a JSON text, also its words."""
    by_words = text_mutator(words)
    values = (*_VALUES, *words)

    def mutate(random: Random, pool: Sequence[bytes]) -> bytes:
        if random.random() < 0.25:
            return by_words(random, pool)
        try:
            tree = json.loads(random.choice(pool))
            donor = json.loads(random.choice(pool))
        except (ValueError, RecursionError):
            return by_words(random, pool)
        for _ in range(random.choice(_HOW_MANY)):
            tree = _change_tree(random, tree, donor, values)
        try:
            text = json.dumps(tree, ensure_ascii=random.random() < 0.5)
        except (ValueError, RecursionError):
            return by_words(random, pool)
        return text.encode("utf-8", "surrogatepass")[:_LONGEST]

    return mutate


def _change_tree(random: Random, tree: Any, donor: Any, values: Sequence[Any]) -> Any:
    """The tree with one change at a random place; a change at its root is rare."""
    place: Any = tree
    above: list[tuple[Any, Any]] = []
    while isinstance(place, dict | list) and place and (not above or random.random() < 0.8):
        key = (
            random.choice(list(place)) if isinstance(place, dict) else random.randrange(len(place))
        )
        above.append((place, key))
        place = place[key]
    if not above:
        return deepcopy(random.choice(values))
    parent, key = above[-1]
    kind = random.randrange(6)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, list):
        parent.insert(key, deepcopy(random.choice((parent[key], *values))))
    elif kind == 1:
        parent[str(random.choice(values))] = deepcopy(random.choice((parent[key], *values)))
    elif kind == 2:
        parent[key] = deepcopy(_any_part(random, donor))
    elif kind == 3 and isinstance(parent[key], str):
        text = parent[key]
        at = random.randrange(len(text) + 1)
        parent[key] = text[:at] + str(random.choice(values)) + text[at:]
    elif kind == 4 and type(parent[key]) in (int, float):
        number = parent[key]
        more: tuple[Callable[[Any], Any], ...] = (
            lambda n: -n,
            lambda n: n + 1,
            lambda n: n * 10**9,
            lambda n: str(n),
            lambda n: int(n) << 64 if n == n and abs(n) < 1e300 else n,
        )
        parent[key] = random.choice(more)(number)
    else:
        parent[key] = deepcopy(random.choice(values))
    return tree


def _any_part(random: Random, tree: Any) -> Any:
    while isinstance(tree, dict | list) and tree and random.random() < 0.8:
        tree = random.choice(list(tree.values() if isinstance(tree, dict) else tree))
    return tree
