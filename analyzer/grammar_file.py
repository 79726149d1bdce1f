"""Loads a grammar from a file, or from the text in a capture; `spec` itself opens no file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import bilprov.spec
from bilprov.analyzer.files import read_bounded
from bilprov.captures.text import printable
from bilprov.spec.protocol import GrammarError, Protocol, grammar_hash, load

_MOST = 1 << 20  # bytes of a grammar file


@cache
def load_protocol(path: str | None = None) -> Protocol:
    """Load the protocol of a grammar file, the kit's own where `path` is None.

    Raises GrammarError, in one sentence, for a file that cannot be read or is no grammar.
    """
    file = Path(path) if path else Path(bilprov.spec.__path__[0]) / "grammar.py"
    try:
        source = read_bounded(file, _MOST, pipes=True).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
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
