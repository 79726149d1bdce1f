"""Loads a grammar by its name, from a file or from a capture's text; `spec` opens no file."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from os import PathLike
from pathlib import Path
from typing import TypeAlias

import bilprov.spec
from bilprov.analyzer.files import read_text
from bilprov.captures.text import printable
from bilprov.spec.protocol import GrammarError, Protocol, grammar_hash, load

OWN = "robot-car"
"""The grammar that is used unless another one is named."""
SHIPPED = {
    OWN: "grammar.py",
    "modbus-rtu": "grammars/modbus_rtu.py",
    "stk500v1": "grammars/stk500v1.py",
    "dynamixel1": "grammars/dynamixel1.py",
}
"""The grammars of the kit by name: the file of each, below the package `spec`."""
_MODULES = {
    f"bilprov.spec.{file.removesuffix('.py').replace('/', '.')}": file for file in SHIPPED.values()
}
"""The same files by the modules from which another grammar can import."""
_MOST = 1 << 20  # bytes of a grammar file


def dissector_program() -> str:
    """The program of the Wireshark dissector, for any grammar."""
    return Path(bilprov.spec.__path__[0], "emit", "dissector.lua").read_text(encoding="utf-8")


Grammar: TypeAlias = str | PathLike[str] | Protocol
"""A grammar: its name, its file, or the protocol that was loaded from it."""


def given_protocol(grammar: Grammar | None) -> Protocol:
    """The protocol itself, or that of a grammar as `load_protocol` loads it."""
    if isinstance(grammar, Protocol):
        return grammar
    return load_protocol(None if grammar is None else str(grammar))


def load_protocol(grammar: str | None = None) -> Protocol:
    """Load the protocol of a grammar: a name in SHIPPED or a file, OWN where it is None.

    A file is read once. Raises GrammarError, in one sentence, for one that cannot be read or is no
    grammar.
    """
    name = grammar or OWN
    folder = ""
    if name not in SHIPPED:
        with suppress(OSError):  # that of a folder that was removed: no file is there
            folder = str(Path.cwd())
    return _loaded(name, folder)


@cache
def _loaded(name: str, folder: str) -> Protocol:
    """The protocol of a grammar whose name is meant in a folder; see `load_protocol`."""
    file = Path(bilprov.spec.__path__[0]) / SHIPPED[name] if name in SHIPPED else Path(name)
    try:
        source = read_text(file, _MOST, pipes=True)
    except OSError as error:
        named = f"name a FILE.py or one of {', '.join(SHIPPED)}"
        if not file.suffix and isinstance(error, FileNotFoundError):
            raise GrammarError(f"there is no grammar {printable(name)}: {named}") from error
        raise GrammarError(
            f"the grammar {file} cannot be read: {error.strerror}; {named}"
        ) from error
    protocol = load(source, file.name)
    whole = with_imported(source)
    return protocol if whole == source else load(whole, file.name)


def with_imported(source: str) -> str:
    """A grammar's text, in which what it imports from a grammar of the kit is declared instead.

    So the text in a capture needs no other grammar, which may be another one in a later version.
    Raises GrammarError if it declares what the imported declarations have under the same name.
    """
    tree, lines = ast.parse(source), source.splitlines(keepends=True)
    for node in reversed([one for one in tree.body if isinstance(one, ast.ImportFrom)]):
        file = _MODULES.get(node.module or "")
        if file:
            wanted, own = {one.name for one in node.names}, set(_assigned(tree))
            lines[node.lineno - 1 : node.end_lineno] = _declarations(file, wanted, own)
    return "".join(lines)


def _declarations(file: str, wanted: set[str], own: set[str]) -> Iterator[str]:
    """The declarations of these names ("*" for all) in a file of the kit, with what they need.

    What the importing grammar declares on its `own` is left out.
    """
    text = Path(bilprov.spec.__path__[0], file).read_text(encoding="utf-8")
    tree, lines = ast.parse(text), text.splitlines(keepends=True)
    if "*" in wanted:
        wanted = set(_assigned(tree))
    needed = wanted - own
    kept: list[ast.stmt] = []
    for node in reversed(tree.body):
        declares = needed.intersection(_assigned(node))
        if declares or isinstance(node, ast.ImportFrom):
            kept.insert(0, node)
            needed |= {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    twice = sorted(needed & own & set(_assigned(tree)))
    if twice:
        raise GrammarError(
            f"a grammar cannot declare {twice[0]}, since declarations that it imports from "
            f"{file} use their own {twice[0]}: give it another name"
        )
    for node in kept:
        yield from lines[node.lineno - 1 : node.end_lineno]


def _assigned(tree: ast.AST) -> list[str]:
    """The names that are assigned."""
    names = (one for one in ast.walk(tree) if isinstance(one, ast.Name))
    return [one.id for one in names if isinstance(one.ctx, ast.Store)]


def grammar_words(protocol: Protocol) -> list[str]:
    """The words of a command line that name a grammar again; none for the usual one."""
    name = protocol.name
    if name not in SHIPPED or load_protocol(name) != protocol:
        name = protocol.origin if protocol.origin.endswith(".py") else "FILE.py"
    return [] if name == OWN else ["--grammar", name]


def not_carried(protocol: Protocol) -> str:
    """A sentence where captures open only with the grammar's file beside them; "" elsewhere."""
    from bilprov.spec.safe_grammar import NotDeclared, require_declarations

    try:
        require_declarations(protocol.source)
    except NotDeclared as error:
        return (
            f"captures made with {protocol.origin} open only with --grammar {protocol.origin}, "
            f"because it does more than declare: {error}"
        )
    return ""


@cache
def carried_protocol(text: str, sha256: str, path: str, origin: str = "") -> Protocol:
    """Load the grammar whose text is in the capture `path`, whoever wrote that.

    `sha256` is the hash that the capture states, "" for none; `origin` is the grammar's file name,
    where it is known. Raises GrammarError, in one sentence, for a text that is damaged, that does
    more than declare (it is not run then), or that is no grammar.
    """
    from bilprov.spec.safe_grammar import NotDeclared, require_declarations

    name = printable(path)
    advice = "give the grammar's file with --grammar FILE.py"
    if sha256 not in ("", grammar_hash(text)):
        raise GrammarError(f"the grammar in {name} is damaged (its hash is another): {advice}")
    try:
        require_declarations(text)
    except NotDeclared as error:
        raise GrammarError(
            f"the grammar in {name} is not run, because it does more than declare ({error}): "
            f"{advice}"
        ) from error
    try:
        return load(text, origin or f"in {name}")
    except GrammarError as error:
        raise GrammarError(f"{error}; or {advice}") from error
