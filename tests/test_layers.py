"""Architecture rules: which package imports which, and where each library may be used.

ruff holds others of the house: imports are absolute, and each module has a docstring.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from functools import cache, lru_cache
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
    ("spec.grammars",),
    ("spec.emit",),
    ("spec.arrays",),
    ("captures",),  # closing, errors, schemas, text, topics: values
    ("captures.storage",),
    (
        "captures.reader",
        "captures.background",
        "captures.parts",
        "captures.recorded",
        "captures.writer",
    ),
    ("analyzer",),  # files, foreign, grammar_file, version
    ("analyzer.html",),
    ("analyzer.transport",),
    ("analyzer.simulated",),
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
    ("conformance.causes",),
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
    "construct": ("spec/",),
    "serial": ("analyzer/transport/port.py", "analyzer/transport/machine.py"),
    "mcap": ("captures/",),
    "numpy": (
        "spec/arrays/",
        "captures/events.py",
        "captures/recorded.py",
        "captures/storage/",
        "analyzer/decode/batch.py",
        "analyzer/decode/columns.py",
        "analyzer/totals/",
        "analyzer/filters/masks.py",
        "analyzer/screen/",
        "conformance/causes/learner.py",
    ),
    "pyarrow": ("analyzer/export/rows.py",),
    "aalpy": ("conformance/learning/learner.py",),
    "textual": ("analyzer/screen/",),
    "rich": ("analyzer/", "conformance/", FRONT_DOOR),
    "prompt_toolkit": ("conformance/cli/shell/prompt.py",),
    "click": ("analyzer/", "conformance/", FRONT_DOOR),
    # The kit runs without it: these are imported by pytest alone.
    "pytest": (
        "conformance/pytest_plugin/__init__.py",
        "conformance/pytest_plugin/session.py",
    ),
    "_pytest": (),
}

# `spec` is pure: no port, file, clock or thread.
IMPURE = {
    *("asyncio", "concurrent", "datetime", "io", "multiprocessing", "os", "pathlib", "select"),
    *("selectors", "shutil", "signal", "socket", "subprocess", "sys", "tempfile", "threading"),
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
    """A module that is imported, its line, and whether only when a function runs."""

    module: str
    line: int
    lazy: bool


MODULES = {module_name(path) for path in product()} - {"bilprov"}


@lru_cache(1)
def nodes(source: str) -> tuple[ast.AST, ...]:
    """All that a text is made of."""
    return tuple(ast.walk(ast.parse(source)))


@cache
def imports(source: str) -> list[Import]:
    """Every import of a text; a string that names a module of ours is one, too."""
    functions = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
    run = {
        id(inner)
        for node in nodes(source)
        if isinstance(node, functions)
        for inner in ast.walk(node)
    }
    return [
        Import(name, node.lineno, id(node) in run or isinstance(node, ast.Constant))
        for node in nodes(source)
        if isinstance(node, ast.Import | ast.ImportFrom | ast.Constant)
        for name in _named(node)
    ]


def _named(node: ast.Import | ast.ImportFrom | ast.Constant) -> Iterator[str]:
    if isinstance(node, ast.Constant):
        yield from [node.value] if node.value in MODULES else []
    elif isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    else:
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rank_of(module: str) -> int | None:
    """The place of a module's room in the order; None for a module that is none of ours."""
    while module and module not in RANKS:
        module = module.rpartition(".")[0]
    return RANKS.get(module)


def broken(path: str, source: str) -> Iterator[str]:
    """The rules that a file breaks, a sentence each."""
    own = rank_of(module_name(path))
    assert own is not None, path
    for module, line, lazy in imports(source):
        library, rank = module.split(".")[0], rank_of(module)
        homes = HOMES.get(library)
        if (rank or 0) > own:
            yield f"{path}:{line} imports {module}: it stands above"
        if library in ("tests", "benchmarks", "docs", "examples"):
            yield f"{path}:{line} imports {module}: it is not part of the product"
        if rank is not None and "cli" in module.split(".") and not _may_import_cli(path, lazy):
            yield f"{path}:{line} imports {module}: only {FRONT_DOOR} may, inside a function"
        if homes is not None and not any(_is_in(path, home) for home in homes):
            yield f"{path}:{line} imports {module}: it may be met in {', '.join(homes)} only"
        if path.startswith("spec/") and library in IMPURE:
            yield f"{path}:{line} imports {module}: spec is pure"
    yield from _impure_calls(path, source)
    yield from _instructions_named(path, source)


def _may_import_cli(path: str, lazy: bool) -> bool:
    front_end = "cli" in path.split("/") or path.startswith(PLUGIN)
    return front_end or (path == FRONT_DOOR and lazy)


def _is_in(path: str, home: str) -> bool:
    return path == home or (home.endswith("/") and path.startswith(home))


def _impure_calls(path: str, source: str) -> Iterator[str]:
    """`spec` meets no file and no terminal."""
    for node in nodes(source) if path.startswith("spec/") else ():
        if isinstance(node, ast.Call) and ast.unparse(node.func) in IMPURE_CALLS:
            yield f"{path}:{node.lineno} calls {ast.unparse(node.func)}(): spec is pure"


def _instructions_named(path: str, source: str) -> Iterator[str]:
    """An instruction's name stands in the grammar; all others ask the Protocol."""
    for node in nodes(source) if path not in NAMES_AT_HOME else ():
        if isinstance(node, ast.Constant) and node.value in INSTRUCTION_NAMES:
            yield f"{path}:{node.lineno} says {node.value!r}: ask the Protocol"


@pytest.mark.slow
@pytest.mark.parametrize("path", product())
def test_the_file_keeps_every_rule(path: str) -> None:
    assert list(broken(path, (ROOT / path).read_text(encoding="utf-8"))) == []


BROKEN = {
    "captures/writer.py": "from bilprov.analyzer.version import kit_version",
    "captures/reader.py": "if TYPE_CHECKING:\n    import bilprov.analyzer.transport.port",
    "spec/emit/lua.py": "import_module('bilprov.analyzer.transport.port')",
    "conformance/cases/single_frames.py": "from tests.vectors import FRAMES",
    "analyzer/api.py": "def f():\n    import bilprov.analyzer.cli.sniff",
    FRONT_DOOR: "from bilprov.analyzer.cli.decode import explain",
    "analyzer/taps/sources.py": "from serial.tools import list_ports",
    "captures/info.py": "def f():\n    import click",
    "spec/framing.py": "import time",
    "spec/protocol.py": "with open('x') as file: pass",
    "analyzer/decode/session.py": "if name == 'Stop': pass",
}


@pytest.mark.parametrize("path", BROKEN)
def test_what_breaks_a_rule_is_found(path: str) -> None:
    assert list(broken(path, BROKEN[path]))


def test_every_room_of_the_house_is_walked_through() -> None:
    assert {rank_of(module_name(path)) for path in product()} == set(range(len(ROOMS)))


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
