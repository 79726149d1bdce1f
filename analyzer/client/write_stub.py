"""Generates `robot.pyi` from the kit's own grammar.

Run it as `python -m bilprov.analyzer.client.write_stub`.
"""

from __future__ import annotations

from pathlib import Path

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.emit.python_stub import python_stub

STUB = Path(__file__).with_name("robot.pyi")


def main() -> None:
    """Write the stub."""
    STUB.write_text(python_stub(load_protocol()), encoding="utf-8")


if __name__ == "__main__":
    main()
