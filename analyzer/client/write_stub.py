"""`python -m analyzer.robot_stub` writes `robot.pyi` anew, out of the kit's own grammar."""

from __future__ import annotations

from pathlib import Path

from analyzer.grammar_file import load_protocol
from spec.emit.python_stub import python_stub

STUB = Path(__file__).with_name("robot.pyi")


def main() -> None:
    """Write the stub."""
    STUB.write_text(python_stub(load_protocol()), encoding="utf-8")


if __name__ == "__main__":
    main()
