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
    from bilprov.analyzer.client.robot import Robot as Robot
    from bilprov.analyzer.grammar_file import load_protocol as load_protocol
    from bilprov.analyzer.transport.errors import LinkError as LinkError
    from bilprov.captures.reader import open_capture as open_capture
    from bilprov.captures.schemas import Look as Look
    from bilprov.conformance.api import Options as Options
    from bilprov.conformance.api import conform as conform

__all__ = [
    "LinkError",
    "Look",
    "NoAnswer",
    "Options",
    "Refused",
    "Robot",
    "RobotError",
    "conform",
    "decode",
    "encode",
    "explain",
    "judge",
    "load_protocol",
    "main",
    "open_capture",
    "read_capture",
    "sniff",
]

# What the import hands on: name -> (module, attribute).
API = {
    "LinkError": ("bilprov.analyzer.transport.errors", "LinkError"),
    "Look": ("bilprov.captures.schemas", "Look"),
    "NoAnswer": ("bilprov.analyzer.client.driver", "NoAnswer"),
    "Options": ("bilprov.conformance.api", "Options"),
    "Refused": ("bilprov.analyzer.client.driver", "Refused"),
    "Robot": ("bilprov.analyzer.client.robot", "Robot"),
    "RobotError": ("bilprov.analyzer.client.driver", "RobotError"),
    "conform": ("bilprov.conformance.api", "conform"),
    "decode": ("bilprov.analyzer.api", "decode"),
    "encode": ("bilprov.analyzer.api", "encode"),
    "explain": ("bilprov.analyzer.api", "explain"),
    "judge": ("bilprov.analyzer.api", "judge"),
    "load_protocol": ("bilprov.analyzer.grammar_file", "load_protocol"),
    "main": ("bilprov.__main__", "main"),
    "open_capture": ("bilprov.captures.reader", "open_capture"),
    "read_capture": ("bilprov.analyzer.api", "read_capture"),
    "sniff": ("bilprov.analyzer.api", "sniff"),
}


def __getattr__(name: str) -> Any:
    if name not in API:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = API[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)
