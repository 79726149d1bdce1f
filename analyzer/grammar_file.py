"""Loads a grammar by its name, from a file or from a capture's text; `spec` opens no file."""

from __future__ import annotations

from functools import cache
from os import PathLike
from pathlib import Path

import bilprov.spec
from bilprov.analyzer.files import read_bounded
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
_MOST = 1 << 20  # bytes of a grammar file


def dissector_program() -> str:
    """The program of the Wireshark dissector, which is the same for every grammar."""
    return Path(bilprov.spec.__path__[0], "emit", "dissector.lua").read_text(encoding="utf-8")


def given_protocol(grammar: str | PathLike[str] | Protocol | None) -> Protocol:
    """The protocol itself, or that of a grammar as `load_protocol` loads it."""
    if isinstance(grammar, Protocol):
        return grammar
    return load_protocol(None if grammar is None else str(grammar))


@cache
def load_protocol(grammar: str | None = None) -> Protocol:
    """Load the protocol of a grammar: a name in SHIPPED or a file, OWN where it is None.

    Raises GrammarError, in one sentence, for a file that cannot be read or is no grammar.
    """
    name = grammar or OWN
    file = Path(bilprov.spec.__path__[0]) / SHIPPED[name] if name in SHIPPED else Path(name)
    try:
        source = read_bounded(file, _MOST, pipes=True).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        if not file.suffix and isinstance(error, FileNotFoundError):
            raise GrammarError(
                f"there is no grammar {printable(name)}: name a FILE.py or one of "
                f"{', '.join(SHIPPED)}"
            ) from error
        raise GrammarError(
            f"the grammar {file} cannot be read: {what}; start from a copy of spec/grammar.py"
        ) from error
    return load(source, file.name)


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
    try:
        require_declarations(text)
    except NotDeclared as error:
        raise GrammarError(
            f"the grammar in {name} is not run, because it does more than declare ({error}): "
            f"{advice}"
        ) from error
    if sha256 not in ("", grammar_hash(text)):
        raise GrammarError(f"the grammar in {name} is damaged (its hash is another): {advice}")
    try:
        return load(text, origin or f"in {name}")
    except GrammarError as error:
        raise GrammarError(f"{error}; or {advice}") from error
