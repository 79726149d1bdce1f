"""The house keeps its order: who imports whom, and where which library is met.

Each rule is a function from a file's path and text to the sentences that it breaks; every rule is
itself tested on a snippet that breaks it and on one that does not.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.vectors import HEADERS

ROOT = Path(__file__).resolve().parent.parent

# Each layer may import itself and what stands before it.
LAYERS = ("spec", "captures", "analyzer", "conformance", "bilprov")
FRONT_DOOR = "bilprov.py"

# Where each library may be met: files, or folders that end in a slash.
HOMES = {
    "construct": ("spec/grammar.py", "spec/fields.py", "spec/protocol.py", "spec/codec.py"),
    "serial": ("analyzer/transport/ports.py",),
    "mcap": ("captures/",),
    "rich": ("analyzer/", "conformance/", FRONT_DOOR),
    "rich_click": ("analyzer/", "conformance/", FRONT_DOOR),
    "click": ("analyzer/", "conformance/", FRONT_DOOR),
    # The kit runs without it: these are imported by pytest alone.
    "pytest": (
        "conformance/pytest_plugin.py",
        "conformance/pytest_plugin/session.py",
        "conformance/pytest_plugin/case_item.py",
    ),
    "_pytest": (),
}

# `spec` is pure: no port, file, clock or thread.
IMPURE = {
    "asyncio",
    "concurrent",
    "datetime",
    "io",
    "multiprocessing",
    "os",
    "pathlib",
    "select",
    "selectors",
    "shutil",
    "signal",
    "socket",
    "subprocess",
    "sys",
    "tempfile",
    "threading",
    "time",
}
IMPURE_CALLS = {"open", "print", "input"}

INSTRUCTION_NAMES = {row.name for row in HEADERS}
NAMES_AT_HOME = ("spec/grammar.py", "spec/readings.py")


class Import(NamedTuple):
    """A module that is imported (dots and all), its line, and whether only when a function runs."""

    module: str
    line: int
    lazy: bool
    level: int


def _imports(source: str) -> list[Import]:
    """Every import of a text, those by `import_module("...")` included."""
    return list(_imports_below(ast.parse(source), lazy=False))


def _imports_below(node: ast.AST, lazy: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            for alias in child.names:
                yield Import(alias.name, child.lineno, lazy, 0)
        elif isinstance(child, ast.ImportFrom):
            for alias in child.names:
                module = f"{child.module}.{alias.name}" if child.module else alias.name
                yield Import(module, child.lineno, lazy, child.level)
        elif isinstance(child, ast.Call) and _called(child) in ("import_module", "__import__"):
            for argument in child.args[:1]:
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                    name = argument.value
                    dots = len(name) - len(name.lstrip("."))
                    yield Import(name.lstrip("."), child.lineno, True, dots)
        inner = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        yield from _imports_below(child, lazy or inner)


def _called(call: ast.Call) -> str:
    if isinstance(call.func, ast.Attribute):
        return call.func.attr
    return call.func.id if isinstance(call.func, ast.Name) else ""


def _layer(path: str) -> int:
    return LAYERS.index(path.removesuffix(".py").split("/")[0])


def _is_cli(module: str) -> bool:
    """Whether one of our own modules is a `cli` or a `cli_something`."""
    top, *rest = module.split(".")
    return top in LAYERS and any(part == "cli" or part.startswith("cli_") for part in rest)


def against_the_direction(path: str, source: str) -> list[str]:
    """Imports run one way: spec <- captures <- analyzer <- conformance <- bilprov.py."""
    return [
        f"{path}:{i.line} imports {i.module}: it stands above"
        for i in _imports(source)
        for top in [i.module.split(".")[0]]
        if top in LAYERS and LAYERS.index(top) > _layer(path)
    ]


def of_what_is_no_product(path: str, source: str) -> list[str]:
    """The product imports neither its tests nor its benchmarks."""
    return [
        f"{path}:{i.line} imports {i.module}: it is not part of the product"
        for i in _imports(source)
        if i.module.split(".")[0] in ("tests", "benchmarks", "vectors", "conftest")
    ]


def cli_outside_the_front_door(path: str, source: str) -> list[str]:
    """Only bilprov.py imports a `cli`, and only when it is asked for."""
    return [
        f"{path}:{i.line} imports {i.module}: only {FRONT_DOOR} may, inside a function"
        for i in _imports(source)
        if _is_cli(i.module) and not (path == FRONT_DOOR and i.lazy)
    ]


def library_away_from_home(path: str, source: str) -> list[str]:
    """construct, serial, mcap, rich and click are met only where they belong."""
    return [
        f"{path}:{i.line} imports {i.module}: it may be met in {', '.join(homes)} only"
        for i in _imports(source)
        if (homes := HOMES.get(i.module.split(".")[0])) is not None
        and not any(path == home or (home[-1] == "/" and path.startswith(home)) for home in homes)
    ]


def relative(path: str, source: str) -> list[str]:
    """Imports are absolute."""
    return [f"{path}:{i.line} imports relatively" for i in _imports(source) if i.level]


def impure(path: str, source: str) -> list[str]:
    """`spec` meets no port, file, clock or thread."""
    if not path.startswith("spec/"):
        return []
    found = [
        f"{path}:{i.line} imports {i.module}: spec is pure"
        for i in _imports(source)
        if i.module.split(".")[0] in IMPURE
    ]
    return found + [
        f"{path}:{node.lineno} calls {_called(node)}(): spec is pure"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and _called(node) in IMPURE_CALLS
    ]


def without_promise(path: str, source: str) -> list[str]:
    """The first docstring line is the room's promise."""
    promise = (ast.get_docstring(ast.parse(source)) or "").split("\n")[0].strip()
    return [] if promise else [f"{path} has no first docstring line"]


def naming_an_instruction(path: str, source: str) -> list[str]:
    """An instruction's name stands in the grammar; all others ask the Protocol."""
    if path in NAMES_AT_HOME:
        return []
    tree = ast.parse(source)
    # Docstrings are prose, and what __all__ lists are names of Python's.
    exempt = {
        id(inner)
        for node in ast.walk(tree)
        if (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        or (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__")
        for inner in ast.walk(node)
    }
    return [
        f"{path}:{node.lineno} says {node.value!r}: ask the Protocol"
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value in INSTRUCTION_NAMES
        and id(node) not in exempt
    ]


RULES: tuple[Callable[[str, str], list[str]], ...] = (
    against_the_direction,
    of_what_is_no_product,
    cli_outside_the_front_door,
    library_away_from_home,
    relative,
    impure,
    without_promise,
    naming_an_instruction,
)


def _product() -> list[str]:
    files = [path for layer in LAYERS for path in (ROOT / layer).rglob("*.py")]
    files += [path for path in [ROOT / FRONT_DOOR] if path.exists()]
    return sorted(path.relative_to(ROOT).as_posix() for path in files)


@pytest.mark.parametrize("path", _product())
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_file_keeps_the_rule(path: str, rule: Callable[[str, str], list[str]]) -> None:
    assert rule(path, (ROOT / path).read_text(encoding="utf-8")) == []


def test_every_room_of_the_house_is_walked_through() -> None:
    rooms = {path.split("/")[0] for path in _product()}

    assert {"spec", "captures", "analyzer", "conformance"} <= rooms
    assert {"spec/grammar.py", "spec/codec.py", "analyzer/transport/ports.py"} <= set(_product())


def test_every_package_that_is_installed_is_walked_through() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = declared["tool"]["setuptools"]["packages"]

    assert {name.split(".")[0] for name in packages} == set(LAYERS) - {"bilprov"}
    folders = {
        file.parent.relative_to(ROOT) for layer in LAYERS for file in ROOT.glob(f"{layer}/**/*.py")
    }
    assert {str(folder).replace("/", ".") for folder in folders} == set(packages)


BROKEN = [
    (against_the_direction, "spec/codec.py", "import captures.schemas"),
    (against_the_direction, "spec/codec.py", "from captures import schemas"),
    (against_the_direction, "captures/writer.py", "from analyzer.version import kit_version"),
    (against_the_direction, "analyzer/decode/session.py", "import bilprov"),
    (against_the_direction, "analyzer/decode/session.py", "def f():\n    import conformance.cases"),
    (against_the_direction, "spec/emit/lua.py", "import_module('analyzer.transport.ports')"),
    (
        against_the_direction,
        "captures/writer.py",
        "if TYPE_CHECKING:\n    from analyzer.ports import Port",
    ),
    (
        of_what_is_no_product,
        "conformance/cases/single_frames.py",
        "from tests.vectors import FRAMES",
    ),
    (of_what_is_no_product, "conformance/cases/single_frames.py", "import benchmarks.run"),
    (cli_outside_the_front_door, "conformance/demo.py", "from analyzer import cli"),
    (cli_outside_the_front_door, "conformance/demo.py", "def f():\n    import conformance.cli"),
    (
        cli_outside_the_front_door,
        "analyzer/cli/text_commands.py",
        "from analyzer.cli_sniff import sniff",
    ),
    (cli_outside_the_front_door, "bilprov.py", "from analyzer.cli import info"),
    (cli_outside_the_front_door, "bilprov.py", "class A:\n    import analyzer.cli_decode"),
    (
        cli_outside_the_front_door,
        "analyzer/api.py",
        "importlib.import_module('analyzer.cli.text_commands')",
    ),
    (library_away_from_home, "spec/motion.py", "from construct import Byte"),
    (library_away_from_home, "analyzer/decode/session.py", "import construct.core"),
    (library_away_from_home, "analyzer/taps/passive.py", "import serial"),
    (library_away_from_home, "analyzer/ports_more.py", "from serial.tools import list_ports"),
    (library_away_from_home, "analyzer/decode/session.py", "from mcap.reader import make_reader"),
    (library_away_from_home, "spec/explain.py", "from rich.table import Table"),
    (library_away_from_home, "captures/info.py", "import rich_click as click"),
    (library_away_from_home, "captures/info.py", "def f():\n    import click"),
    (library_away_from_home, "conformance/pytest_plugin/bench.py", "def f():\n    import pytest"),
    (relative, "spec/codec.py", "from . import fields"),
    (relative, "spec/codec.py", "from .fields import Outcome"),
    (relative, "analyzer/api.py", "import_module('.ports', 'analyzer')"),
    (impure, "spec/framing.py", "import time"),
    (impure, "spec/framing.py", "from os import path"),
    (impure, "spec/protocol.py", "def f():\n    from pathlib import Path"),
    (impure, "spec/protocol.py", "with open('x') as file: pass"),
    (impure, "spec/emit/lua.py", "print('x')"),
    (without_promise, "spec/codec.py", "import ast"),
    (without_promise, "spec/codec.py", "'''   '''"),
    (without_promise, "spec/codec.py", "# only a comment"),
    (naming_an_instruction, "analyzer/decode/session.py", "if name == 'Stop': pass"),
    (naming_an_instruction, "analyzer/decode/session.py", "show('LED')"),
    (naming_an_instruction, "spec/codec.py", "def f(name: Literal['LED']): pass"),
    (
        naming_an_instruction,
        "conformance/cases/single_frames.py",
        "class A:\n    '''A.'''\n    x = {'Right': 1}",
    ),
]

KEPT = [
    (
        against_the_direction,
        "conformance/cases/single_frames.py",
        "import spec.codec\nimport analyzer.ports",
    ),
    (against_the_direction, "captures/reader.py", "import captures.schemas, spec.codec, json"),
    (of_what_is_no_product, "conformance/cases/single_frames.py", "from spec import codec"),
    (cli_outside_the_front_door, "bilprov.py", "def f():\n    from analyzer.cli import info"),
    (cli_outside_the_front_door, "bilprov.py", "row = {'info': 'analyzer.cli.text_commands'}"),
    (cli_outside_the_front_door, "analyzer/taps/passive.py", "from analyzer.ports import client"),
    (library_away_from_home, "spec/codec.py", "from construct import ConstructError"),
    (library_away_from_home, "analyzer/transport/ports.py", "import serial.tools.list_ports"),
    (library_away_from_home, "captures/reader.py", "import mcap.reader"),
    (library_away_from_home, "analyzer/cli/text_commands.py", "import rich.table, rich_click"),
    (library_away_from_home, "conformance/pytest_plugin/case_item.py", "import pytest"),
    (relative, "spec/codec.py", "from spec import fields\nimport_module('spec.fields')"),
    (impure, "spec/codec.py", "import hashlib\nfrom dataclasses import dataclass"),
    (impure, "analyzer/transport/ports.py", "import time\nopen('x')"),
    (without_promise, "spec/codec.py", "'''Bytes in, frames out.'''\nimport ast"),
    (naming_an_instruction, "spec/grammar.py", "NAME = 'Stop'"),
    (naming_an_instruction, "analyzer/transport/server.py", "__all__ = ['Stop']"),
    (naming_an_instruction, "spec/codec.py", "'''Stop'''\nx = 'stop'  # 'Stop'\ny = 'Stop now'"),
]


def _short(value: object) -> str:
    return getattr(value, "__name__", str(value)).replace("\n", " ")


@pytest.mark.parametrize(("rule", "path", "source"), BROKEN, ids=_short)
def test_a_rule_finds_what_breaks_it(
    rule: Callable[[str, str], list[str]], path: str, source: str
) -> None:
    (sentence,) = rule(path, source)

    assert sentence.startswith(path)


@pytest.mark.parametrize(("rule", "path", "source"), KEPT, ids=_short)
def test_a_rule_lets_pass_what_keeps_it(
    rule: Callable[[str, str], list[str]], path: str, source: str
) -> None:
    assert rule(path, source) == []


def test_no_rule_is_left_untested() -> None:
    assert {rule for rule, _, _ in BROKEN} == {rule for rule, _, _ in KEPT} == set(RULES)
