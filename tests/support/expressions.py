"""Random filter expressions for Hypothesis, built from the names and words of a protocol."""

from __future__ import annotations

from typing import Any

from bilprov.analyzer.output.filter import names, words
from hypothesis import strategies as st

from bilprov.spec.protocol import Protocol

_NUMBERS = [0, 1, -1, 2, 7, 100, 255, 0.5, 0.001, 0.1, 1e-9, 1e308 * 10, (1 << 53) + 1, -(1 << 80)]
_ORDER = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
_AMONG = st.sampled_from(["in", "not in"])
_TEXTS = ["", "00", "02", "81 09", "LED", "a", "slow", "disagreeing", "faulty instruction"]


def expressions(protocol: Protocol) -> st.SearchStrategy[str]:
    """Filters that compile: comparisons of all kinds, joined."""
    by_kind: dict[str, list[str]] = {}
    for name, node in names(protocol).items():
        by_kind.setdefault(node.kind, []).append(name)
    number = st.sampled_from(by_kind["number"]) | st.sampled_from(_NUMBERS).map(_literal)
    text = (
        st.sampled_from(by_kind["text"])
        | st.sampled_from([repr(word) for word in words(protocol)])
        | st.sampled_from(_TEXTS).map(repr)
    )
    truth = st.sampled_from([*by_kind["truth"], "True", "False"])
    simple = st.one_of(
        truth,
        _infix(number, _ORDER, number),
        _infix(_infix(number, _ORDER, number), _ORDER, number),
        _infix(number, _AMONG, _listed(number)),
        _infix(text, _ORDER, text),
        _infix(text, _AMONG, _listed(text)),
        _infix(text, _AMONG, text),
        _infix(text, _AMONG, st.just("faults")),
        _infix(truth, st.sampled_from(["==", "!="]), truth),
        _infix(truth, _AMONG, _listed(truth)),
        _infix(st.just("faults"), st.sampled_from(["==", "!="]), _listed(text)),
        _infix(_listed(number), st.sampled_from(["==", "!="]), _listed(number)),
    )
    return st.recursive(
        simple,
        lambda part: (
            part.map(lambda one: f"not ({one})")
            | _infix(
                part.map("({})".format), st.sampled_from(["and", "or"]), part.map("({})".format)
            )
            | _infix(part.map("({})".format), st.sampled_from(["==", "!="]), truth)
        ),
        max_leaves=4,
    ).filter(lambda expression: len(expression) < 900)


def _joined(part: st.SearchStrategy[str], truth: st.SearchStrategy[str]) -> Any:
    return (
        part.map("not {}".format)
        | _infix(part, st.sampled_from(["and", "or"]), part)
        | _infix(part, st.sampled_from(["==", "!="]), truth)
    )


def _literal(number: float) -> str:
    return "1e999" if number == float("inf") else repr(number)


def _infix(
    left: st.SearchStrategy[str], sign: st.SearchStrategy[str], right: st.SearchStrategy[str]
) -> st.SearchStrategy[str]:
    return st.tuples(left, sign, right).map(" ".join)


def _listed(part: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    parts = st.lists(part, min_size=1, max_size=3)
    return parts.map(lambda several: "(" + "".join(f"{one}, " for one in several) + ")")
