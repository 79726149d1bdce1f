"""Reads a grammar file from disk; `spec` itself opens no file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import bilprov.spec
from bilprov.captures.text import printable
from bilprov.spec.protocol import GrammarError, Protocol, load


@cache
def load_protocol(path: str | None = None) -> Protocol:
    """Load the protocol of a grammar file, the kit's own where `path` is None.

    Raises GrammarError, in one sentence, for a file that cannot be read or is no grammar.
    """
    file = Path(path) if path else Path(bilprov.spec.__path__[0]) / "grammar.py"
    try:
        source = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise GrammarError(
            f"the grammar {file} cannot be read: {what}; start from a copy of spec/grammar.py"
        ) from error
    return load(source, printable(file.name))
