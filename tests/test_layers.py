"""Architecture rules: which package imports which, and where each library may be used.

Each rule is a function from a file's path and text to the sentences that it breaks; every rule is
itself tested on a snippet that breaks it and on one that does not.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support import ROOT
from tests.vectors import HEADERS

PACKAGES = ("spec", "captures", "analyzer", "conformance")
FRONT_DOOR = "src/bilprov/__main__.py"
NAMES_FOR_PYTHON = "src/bilprov/__init__.py"

# The rooms, each a package or the modules at a package's root that belong together: a room may
# import itself and what stands before it.
ROOMS = (
    ("spec",),
    ("spec.emit",),
    ("captures",),  # closing, errors, schemas, text, topics: values
    ("captures.storage",),
    (
        "captures.evidence",
        "captures.background",
        "captures.chunked_file",
        "captures.parts",
        "captures.recorded",
        "captures.reader",
        "captures.writer",
    ),
    ("analyzer",),  # files, foreign, grammar_file, version
    ("analyzer.html",),
    ("analyzer.transport",),
    ("analyzer.taps",),
    ("analyzer.decode",),
    ("analyzer.totals",),
    ("analyzer.monitor",),
    ("analyzer.filters",),
    ("analyzer.output",),
    ("analyzer.client",),
    ("analyzer.doctor",),
    ("analyzer.replay",),
    ("analyzer.export",),
    ("analyzer.plot",),
    ("analyzer.edit",),
    ("analyzer.pipeline", "analyzer.api"),
    ("analyzer.screen",),
    ("analyzer.cli",),
    ("conformance", "conformance.dut"),
    ("conformance.oracle",),
    ("conformance.machines",),
    ("conformance.cases",),
    ("conformance.report",),
    ("conformance.runner",),
    ("conformance.api", "conformance.recheck"),
    ("conformance.learning",),
    ("conformance.mutation",),
    ("conformance.pytest_plugin",),
    ("conformance.cli",),
    ("bilprov",),
)
RANKS = {
    name if name == "bilprov" else f"bilprov.{name}": rank
    for rank, names in enumerate(ROOMS)
    for name in names
}
PLUGIN = "conformance/pytest_plugin/"  # its options are the commands'
MOST_FILES = 26  # of one folder: more is two ideas

# Where each library may be met: files, or folders that end in a slash.
HOMES = {
    "construct": ("spec/grammar.py", "spec/fields.py", "spec/protocol.py", "spec/codec.py"),
    "serial": ("analyzer/transport/ports.py",),
    "mcap": ("captures/",),
    "numpy": (
        "spec/tables.py",
        "captures/events.py",
        "captures/recorded.py",
        "captures/storage/",
        "analyzer/decode/batch.py",
        "analyzer/decode/regular.py",
        "analyzer/totals/",
        "analyzer/filters/columns.py",
        "analyzer/filters/masks.py",
        "analyzer/screen/",
    ),
    "pyarrow": ("analyzer/export/parquet.py",),
    "aalpy": ("conformance/learning/learner.py",),
    "textual": ("analyzer/screen/",),
    "rich": ("analyzer/", "conformance/", FRONT_DOOR),
    "prompt_toolkit": ("conformance/cli/shell/prompt.py",),
    "click": ("analyzer/", "conformance/", FRONT_DOOR),
    # The kit runs without it: these are imported by pytest alone.
    "pytest": (
        "conformance/pytest_plugin/__init__.py",
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


def product() -> list[str]:
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    files += [ROOT / FRONT_DOOR, ROOT / NAMES_FOR_PYTHON]
    return sorted(path.relative_to(ROOT).as_posix() for path in files)


def module_name(path: str) -> str:
    """The name under which a file is imported."""
    inside = path.removeprefix("src/bilprov/").removesuffix(".py").removesuffix("__init__")
    return f"bilprov.{inside.rstrip('/').replace('/', '.')}".rstrip(".")


class Import(NamedTuple):
    """A module that is imported (dots and all), its line, and whether only when a function runs."""

    module: str
    line: int
    lazy: bool
    level: int


MODULES = {module_name(path) for path in product()} - {"bilprov"}


@lru_cache(maxsize=8)  # each file is asked about by each rule in turn
def _tree(source: str) -> ast.Module:
    return ast.parse(source)


@lru_cache(maxsize=8)
def imports(source: str) -> list[Import]:
    """Every import of a text; `import_module("...")` and a string that names a module are two."""
    tree = _tree(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    named = [
        Import(node.value, node.lineno, True, 0)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in docstrings
        and node.value in MODULES
    ]
    return list(dict.fromkeys([*_imports_below(tree, lazy=False), *named]))


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


def rank_of(module: str) -> int | None:
    """The place of a module's room in the order; None for a module that is none of ours."""
    while module and module not in RANKS:
        module = module.rpartition(".")[0]
    return RANKS.get(module)


def _is_cli(module: str) -> bool:
    """Whether one of our own modules stands in a `cli`."""
    return "cli" in module.split(".") and rank_of(module) is not None


def against_the_direction(path: str, source: str) -> list[str]:
    """A room imports only itself and the rooms before it, strings that name modules included."""
    own = rank_of(module_name(path))
    assert own is not None, path
    return [
        f"{path}:{i.line} imports {i.module}: it stands above"
        for i in imports(source)
        if (rank_of(i.module) or 0) > own
    ]


def of_what_is_no_product(path: str, source: str) -> list[str]:
    """The product imports neither its tests nor its benchmarks."""
    return [
        f"{path}:{i.line} imports {i.module}: it is not part of the product"
        for i in imports(source)
        if i.module.split(".")[0] in ("tests", "benchmarks", "docs", "examples")
    ]


def cli_outside_the_front_door(path: str, source: str) -> list[str]:
    """A `cli` is imported by front ends, and by bilprov.py only when it is asked for."""
    return [
        f"{path}:{i.line} imports {i.module}: only {FRONT_DOOR} may, inside a function"
        for i in imports(source)
        if _is_cli(i.module)
        and not ("cli" in path.split("/") or path.startswith(PLUGIN))
        and not (path == FRONT_DOOR and i.lazy)
    ]


def library_away_from_home(path: str, source: str) -> list[str]:
    """construct, serial, mcap, rich and click are met only where they belong."""
    return [
        f"{path}:{i.line} imports {i.module}: it may be met in {', '.join(homes)} only"
        for i in imports(source)
        if (homes := HOMES.get(i.module.split(".")[0])) is not None
        and not any(path == home or (home[-1] == "/" and path.startswith(home)) for home in homes)
    ]


def relative(path: str, source: str) -> list[str]:
    """Imports are absolute."""
    return [f"{path}:{i.line} imports relatively" for i in imports(source) if i.level]


def impure(path: str, source: str) -> list[str]:
    """`spec` meets no port, file, clock or thread."""
    if not path.startswith("spec/"):
        return []
    found = [
        f"{path}:{i.line} imports {i.module}: spec is pure"
        for i in imports(source)
        if i.module.split(".")[0] in IMPURE
    ]
    return found + [
        f"{path}:{node.lineno} calls {_called(node)}(): spec is pure"
        for node in ast.walk(_tree(source))
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


@pytest.mark.slow
@pytest.mark.parametrize("path", product())
def test_the_file_keeps_every_rule(path: str) -> None:
    source = (ROOT / path).read_text(encoding="utf-8")

    assert [sentence for rule in RULES for sentence in rule(path, source)] == []


def test_every_room_of_the_house_is_walked_through() -> None:
    assert {rank_of(module_name(path)) for path in product()} == set(range(len(ROOMS)))
    assert {"spec/grammar.py", "spec/codec.py", "analyzer/transport/ports.py"} <= set(product())


@pytest.mark.slow
def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = {
        module_name(path): {
            name
            for i in imports((ROOT / path).read_text(encoding="utf-8"))
            for name in (i.module, i.module.rpartition(".")[0])
            if name in MODULES and name != module_name(path)
        }
        for path in product()
    }

    TopologicalSorter(graph).prepare()  # CycleError names the circle


def test_a_folder_is_taken_in_at_a_glance() -> None:
    folders = Counter(str(Path(path).parent) for path in product())

    assert {folder: n for folder, n in folders.items() if n > MOST_FILES} == {}


def test_every_folder_with_code_is_a_package_of_the_one_that_is_installed() -> None:
    links = {
        path.name: path.readlink() for path in (ROOT / "src/bilprov").iterdir() if path.is_symlink()
    }

    assert links == {name: Path("../..") / name for name in PACKAGES}
    folders = {file.parent for package in PACKAGES for file in ROOT.glob(f"{package}/**/*.py")}
    assert [folder for folder in folders if not (folder / "__init__.py").exists()] == []


BROKEN = [
    (against_the_direction, "spec/codec.py", "import bilprov.captures.schemas"),
    (against_the_direction, "spec/codec.py", "from bilprov.captures import schemas"),
    (
        against_the_direction,
        "captures/writer.py",
        "from bilprov.analyzer.version import kit_version",
    ),
    (against_the_direction, "analyzer/decode/session.py", "import bilprov"),
    (
        against_the_direction,
        "analyzer/decode/session.py",
        "def f():\n    import bilprov.conformance.cases.single_frames",
    ),
    (
        against_the_direction,
        "spec/emit/lua.py",
        "import_module('bilprov.analyzer.transport.ports')",
    ),
    (
        against_the_direction,
        "captures/writer.py",
        "if TYPE_CHECKING:\n    from bilprov.analyzer.transport.ports import Port",
    ),
    (
        of_what_is_no_product,
        "conformance/cases/single_frames.py",
        "from tests.vectors import FRAMES",
    ),
    (of_what_is_no_product, "conformance/cases/single_frames.py", "import benchmarks.run"),
    (cli_outside_the_front_door, "analyzer/api.py", "from bilprov.analyzer import cli"),
    (
        cli_outside_the_front_door,
        "analyzer/api.py",
        "def f():\n    import bilprov.conformance.cli.conform",
    ),
    (
        cli_outside_the_front_door,
        "analyzer/taps/sources.py",
        "from bilprov.analyzer.cli.sniff import sniff",
    ),
    (cli_outside_the_front_door, FRONT_DOOR, "from bilprov.analyzer.cli.text_commands import info"),
    (cli_outside_the_front_door, FRONT_DOOR, "class A:\n    import bilprov.analyzer.cli.decode"),
    (
        cli_outside_the_front_door,
        "analyzer/api.py",
        "importlib.import_module('bilprov.analyzer.cli.text_commands')",
    ),
    (library_away_from_home, "spec/motion.py", "from construct import Byte"),
    (library_away_from_home, "analyzer/decode/session.py", "import construct.core"),
    (library_away_from_home, "analyzer/taps/sources.py", "import serial"),
    (library_away_from_home, "analyzer/ports_more.py", "from serial.tools import list_ports"),
    (library_away_from_home, "analyzer/decode/session.py", "from mcap.reader import make_reader"),
    (library_away_from_home, "analyzer/decode/session.py", "import numpy as np"),
    (library_away_from_home, "spec/explain.py", "from rich.table import Table"),
    (library_away_from_home, "captures/info.py", "import click"),
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
        "import bilprov.spec.codec\nimport bilprov.analyzer.transport.ports",
    ),
    (
        against_the_direction,
        "captures/reader.py",
        "import bilprov.captures.schemas, spec.codec, json",
    ),
    (of_what_is_no_product, "conformance/cases/single_frames.py", "from bilprov.spec import codec"),
    (
        cli_outside_the_front_door,
        FRONT_DOOR,
        "def f():\n    from bilprov.analyzer.cli.text_commands import info",
    ),
    (
        cli_outside_the_front_door,
        FRONT_DOOR,
        "row = {'info': 'bilprov.analyzer.cli.text_commands'}",
    ),
    (
        cli_outside_the_front_door,
        "analyzer/taps/sources.py",
        "from bilprov.analyzer.transport.ports import client",
    ),
    (library_away_from_home, "spec/codec.py", "from construct import ConstructError"),
    (library_away_from_home, "analyzer/transport/ports.py", "import serial.tools.list_ports"),
    (library_away_from_home, "captures/reader.py", "import mcap.reader"),
    (library_away_from_home, "analyzer/cli/text_commands.py", "import rich.table, click"),
    (library_away_from_home, "conformance/pytest_plugin/case_item.py", "import pytest"),
    (
        relative,
        "spec/codec.py",
        "from bilprov.spec import fields\nimport_module('bilprov.spec.fields')",
    ),
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
