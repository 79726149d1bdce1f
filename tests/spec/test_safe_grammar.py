"""Safe grammars: a stranger's grammar runs only if it holds nothing but declarations."""

from __future__ import annotations

import pytest

from bilprov.spec.safe_grammar import LONGEST, NotDeclared, require_declarations
from tests.spec.test_grammar_mutations import MUTATIONS

WORDS = "from construct import BitsInteger, Byte, this\nfrom spec.fields import Outcome, Sets\n"


def test_the_kits_own_grammar_and_the_horns_declare(grammar_text: str, horn_text: str) -> None:
    require_declarations(grammar_text)
    require_declarations(horn_text)


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_changed_grammar_still_declares(grammar_text: str, name: str) -> None:
    for old, new in MUTATIONS[name].items():
        grammar_text = grammar_text.replace(old, new)
    require_declarations(grammar_text)


REFUSED = {
    "a module": "import os",
    "another module's word": "from os import system",
    "a word that computes": "from construct import Computed",
    "a word under another name": "from construct import Byte as Int",
    "a relative import": "from .fields import Sets",
    "everything": "from bilprov.spec.fields import *",
    "a call of Python's": "X = eval('1')",
    "a call of a value": "X = Sets()()",
    "a call of a method": "X = Byte.parse(b'')",
    "Python's own attributes": "X = this.__class__",
    "a private attribute": "X = this._root",
    "an attribute of a text": "X = 'a'.join",
    "an attribute of a word": "X = Sets.values",
    "an attribute of a member": "X = Outcome.VALID.value",
    "a comprehension": "X = [a for a in 'b']",
    "a function": "def f(): pass",
    "a class": "class A: pass",
    "a lambda": "X = lambda: 1",
    "an f-string": "X = f'{1}'",
    "an index": "X = {}[0]",
    "a call that stands alone": "Sets()",
    "an unpacked dict": "X = Sets(**{'a': 1})",
    "a merged dict": "X = {**{}}",
    "an unpacked list": "X = Sets(*[1])",
    "a shift": "X = 1 << 62",
    "a power": "X = 9 ** 9",
    "a long text": "X = 'a' * 9999",
    "a long text by a name": "N = 9999\nX = N * 'a'",
    "a long text by a product": "X = (9999 * 'a') * 'b'",
    "a large number": "X = 99999999999",
    "a wide number": "X = BitsInteger(65)",
    "a wide number by a name": "N = 99999\nX = BitsInteger(N)",
    "a wide number by two names": "N = 99999\nM = N\nX = BitsInteger(M)",
    "bytes": "X = b'1'",
    "a word that is assigned": "Byte = 1",
    "a name of Python's": "__builtins__ = 1",
    "a name assigned twice": "X = 1\nX = 2",
    "a name that is nowhere": "X = Y",
    "two targets": "X = Y = 1",
    "a test": "if 1: pass",
    "what does not parse": "X = (",
    "a null byte": "X = '\0'",
    "deep nesting": "X = " + "(" * 5000 + ")" * 5000,
    "deep signs": "X = " + "-" * 5000 + "1",
}


@pytest.mark.parametrize("text", REFUSED.values(), ids=REFUSED)
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(NotDeclared):
        require_declarations(WORDS + text)


def test_the_sentence_says_what_and_where() -> None:
    with pytest.raises(NotDeclared, match="there is a Import in line 3"):
        require_declarations(WORDS + "import os")


def test_a_very_long_text_is_refused_unread() -> None:
    with pytest.raises(NotDeclared, match="characters"):
        require_declarations("#" * (LONGEST + 1))


def test_a_text_of_the_most_characters_is_read() -> None:
    require_declarations("#" * LONGEST)
