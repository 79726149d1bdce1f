"""Mutants drawn from the code: each changes one place, in a way that Python can notice."""

from __future__ import annotations

import ast

import pytest

from benchmarks.mutants import ROOMS, Mutation, changes_the_tree, draw, mutations
from tests.support import ROOT

pytestmark = pytest.mark.slow  # each reads whole rooms

# What is written, the operator, what the mutants of that operator make of it.
OPERATORS = [
    ("a = b < c", "comparison", ["a = b <= c"]),
    ("a = b == c != d", "comparison", ["a = b != c != d", "a = b == c == d"]),
    ("a = (b) not  in (c)", "comparison", ["a = (b) in (c)"]),
    ("a = b is not c", "comparison", ["a = b is c"]),
    ("a = (b + c) * d", "arithmetic", ["a = (b + c) // d", "a = (b - c) * d"]),
    ("a -= b", "arithmetic", ["a += b"]),
    ("a = b and c or d", "and/or", ["a = b and c and d", "a = b or c or d"]),
    ("a = not (b)", "not removed", ["a =  (b)"]),
    ("a = 0x10", "integer", ["a = 17", "a = 15"]),
    ("a = True", "True/False", ["a = False"]),
    ("a = min(b, c)", "function", ["a = max(b, c)"]),
    ("def a():\n    return b, c", "return value", ["def a():\n    return None"]),
    ("def a():\n    return f(\n    )  # b", "return value", ["def a():\n    return None\n  # b"]),
    ("a = 'ö'; b()", "statement deleted", ["pass; b()", "a = 'ö'; pass"]),
    ("if b:\n    ...", "condition negated", ["if not (b):\n    ..."]),
    ("a = {b for b in c if b}", "condition negated", ["a = {b for b in c if not (b)}"]),
]


def _of(text: str) -> list[Mutation]:
    return list(mutations("a.py", text.encode()))


@pytest.mark.parametrize(("text", "operator", "expected"), OPERATORS)
def test_an_operator_makes_the_change_that_it_is_named_after(
    text: str, operator: str, expected: list[str]
) -> None:
    source = text.encode()
    made = [m.applied(source).decode() for m in _of(text) if m.operator == operator]
    assert made == expected


@pytest.mark.parametrize(
    "text",
    [
        '"""Words."""',
        "__all__ = ['a' + 'b']",
        "a: f(1)",
        "def a(b: f(1) = c) -> f(2): ...",
        "@f(1)\nclass A(f(2), kind=True): ...",
        "if TYPE_CHECKING:\n    a = 1",
        "a: str = f'{1 + 2}'",
        "def a():\n    return None",
    ],
)
def test_what_runs_nowhere_or_says_nothing_is_left_alone(text: str) -> None:
    assert _of(text) == []


@pytest.mark.parametrize("room", ROOMS)
def test_a_drawn_mutant_is_other_python_on_as_many_lines_and_differs_in_one_place(
    room: str,
) -> None:
    drawn = draw(ROOT, room, 20, 7)
    assert len(set(drawn)) == 20
    for mutation in drawn:
        source = (ROOT / mutation.file).read_bytes()
        mutated = mutation.applied(source)
        assert ast.dump(ast.parse(mutated)) != ast.dump(ast.parse(source))
        assert mutated.count(b"\n") == source.count(b"\n")
        assert mutated.startswith(source[: mutation.start])
        assert mutated.endswith(source[mutation.end :])
        assert mutation.file.startswith(ROOMS[room][0])


def test_the_same_seed_draws_the_same_mutants_and_another_seed_others() -> None:
    assert draw(ROOT, "decode", 20, 1) == draw(ROOT, "decode", 20, 1)
    assert draw(ROOT, "decode", 20, 1) != draw(ROOT, "decode", 20, 2)


def test_a_change_that_python_does_not_see_or_cannot_read_is_not_drawn() -> None:
    source = b"a = (b)"
    assert not changes_the_tree(Mutation("a.py", "none", 4, 7, b"b"), source)
    assert not changes_the_tree(Mutation("a.py", "none", 4, 7, b"(b"), source)
    assert changes_the_tree(Mutation("a.py", "none", 4, 7, b"c"), source)


def test_a_mutant_is_told_with_its_line_before_and_after() -> None:
    source = b"a = 1\nif a < b:\n    c()\n"
    told = {mutation.told(source) for mutation in mutations("x.py", source)}
    assert "x.py:2: comparison: if a < b: -> if a <= b:" in told
    assert "x.py:3: statement deleted: c() -> pass" in told


def test_every_room_has_code_and_tests_of_its_own() -> None:
    for folder, tests in ROOMS.values():
        assert list((ROOT / folder).glob("*.py"))
        assert all((ROOT / name).exists() for name in tests)
