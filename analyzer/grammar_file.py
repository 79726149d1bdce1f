"""Reads a grammar file from disk; `spec` itself opens no file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import bilprov.spec
from bilprov.analyzer.files import read_bounded
from bilprov.spec.protocol import GrammarError, Protocol, load

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
