"""The names for Python: `from bilprov import decode, judge, read_capture`; `__all__` lists them.

Each is imported when it is first asked for, and comes with the docstring of where it lives. The
command is `bilprov.__main__`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bilprov.__main__ import main as main
    from bilprov.analyzer.api import decode as decode
    from bilprov.analyzer.api import encode as encode
    from bilprov.analyzer.api import explain as explain
    from bilprov.analyzer.api import judge as judge
    from bilprov.analyzer.api import read_capture as read_capture
    from bilprov.analyzer.api import sniff as sniff
    from bilprov.analyzer.client.driver import NoAnswer as NoAnswer
    from bilprov.analyzer.client.driver import Refused as Refused
    from bilprov.analyzer.client.driver import RobotError as RobotError
    from bilprov.analyzer.client.port_driver import Device as Device
    from bilprov.analyzer.client.robot import Robot as Robot
    from bilprov.analyzer.grammar_file import load_protocol as load_protocol
    from bilprov.analyzer.transport.errors import LinkError as LinkError
    from bilprov.captures.reader import open_capture as open_capture
    from bilprov.captures.schemas import Look as Look
    from bilprov.conformance.api import Options as Options
    from bilprov.conformance.api import conform as conform

# What the import hands on, by module.
_MODULES = {
    "bilprov.__main__": "main",
    "bilprov.analyzer.api": "Look decode encode explain judge read_capture sniff",
    "bilprov.analyzer.client.port_driver": "Device",
    "bilprov.analyzer.client.driver": "NoAnswer Refused RobotError",
    "bilprov.analyzer.client.robot": "Robot",
    "bilprov.analyzer.grammar_file": "load_protocol",
    "bilprov.analyzer.transport.errors": "LinkError",
    "bilprov.captures.reader": "open_capture",
    "bilprov.conformance.api": "Options conform",
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
