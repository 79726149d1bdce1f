"""Generates the Python stub beside `analyzer/client/robot.py`: instructions as typed methods."""

from __future__ import annotations

import textwrap

from bilprov.spec.data import FieldSpec
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.python_names import method_names, parameter_names

RENEW = "python -m bilprov.analyzer.client.write_stub"
"""The command that regenerates the stub of the kit's own grammar."""

_WIDTH = 100
_HEAD = '''\
"""The robot's instructions as methods, for type checkers and editors.

Generated from the grammar (@GRAMMAR@), not edited by hand. To renew it:
`@RENEW@`.
"""

from bilprov.analyzer.client.driver import Answer, Driver
from bilprov.analyzer.client.port_driver import PortDriver

class Instructions(Driver):
    """The instructions of @GRAMMAR@; `Driver` documents what each of them raises."""
'''
_TAIL = '''
class Robot(Instructions, PortDriver):
    """A robot on a port, to be driven from Python."""
'''


def python_stub(protocol: Protocol) -> str:
    """Return the text of a stub (.pyi) with a method for each instruction."""
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
    """Wrap text into docstring lines; the quotes take `taken` characters of the first line."""
    room = _WIDTH - 8
    lines = textwrap.wrap("_" * taken + _quoted(text), room, break_long_words=False)
    return "\n        ".join(lines)[taken:]


def _quoted(text: str) -> str:
    """Return the text as one line that is safe within a docstring."""
    return " ".join(text.split()).replace("\\", "\\\\").replace('"', '\\"')
