"""The instructions as typed Python methods: the stub beside `analyzer/robot.py`, as text."""

from __future__ import annotations

import textwrap

from spec.protocol import FieldSpec, InstructionSpec, Protocol
from spec.python_names import method_names, parameter_names

RENEW = "python -m analyzer.robot_stub"
"""What writes the stub of the kit's own grammar anew."""

_WIDTH = 100
_HEAD = '''\
"""The robot's instructions as methods, for type checkers and editors.

Written out of the grammar (@GRAMMAR@) by `@RENEW@`; do not edit.
"""

from analyzer.driver import Answer, Driver
from analyzer.port_driver import PortDriver

class Instructions(Driver):
    """The instructions of @GRAMMAR@; `Driver` says what each of them raises."""
'''
_TAIL = '''
class Robot(Instructions, PortDriver):
    """A robot on a port, to be driven from Python."""
'''


def python_stub(protocol: Protocol) -> str:
    """The text of a stub (.pyi) with a method for each instruction."""
    grammar = _quoted(f"{protocol.name} {protocol.version}")
    methods = (_method(name, spec) for name, spec in method_names(protocol).items())
    head = _HEAD.replace("@GRAMMAR@", grammar).replace("@RENEW@", RENEW)
    return "\n".join([head, *methods]) + _TAIL


def _method(name: str, spec: InstructionSpec) -> str:
    parameters = parameter_names(spec)
    signature = ", ".join(["self", *(f"{parameter}: int" for parameter in parameters)])
    said = f"    def {name}({signature}) -> Answer:"
    if len(said) > _WIDTH:
        listed = "".join(f"        {part},\n" for part in signature.split(", "))
        said = f"    def {name}(\n{listed}    ) -> Answer:"
    text = _wrapped(spec.prose or spec.name, 3)
    if parameters:
        takes = (_wrapped(_parameter(*pair), 0) for pair in parameters.items())
        text += "\n\n        " + "\n        ".join(takes)
    fits = "\n" not in text and len(text) <= _WIDTH - 8 - 2 * 3
    end = "" if fits else "\n        "
    return f'{said}\n        """{text}{end}"""\n'


def _parameter(name: str, part: FieldSpec) -> str:
    prose = f", {part.prose}" if part.prose else ""
    return f"{name}: {part.low} to {part.high}{prose}"


def _wrapped(text: str, taken: int) -> str:
    """Lines of a docstring; `taken` is how much of the first one the quotes take."""
    room = _WIDTH - 8
    lines = textwrap.wrap("_" * taken + _quoted(text), room, break_long_words=False)
    return "\n        ".join(lines)[taken:]


def _quoted(text: str) -> str:
    """One line that can stand in a docstring."""
    return " ".join(text.split()).replace("\\", "\\\\").replace('"', '\\"')
