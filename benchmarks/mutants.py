"""Do a room's own tests notice when one thing in its code is changed? Seeded mutants, one by one.

`python -m benchmarks.mutants [--seed N] [--count N] [--room NAME] [--slow S]`: small
changes (`<` to `<=`, a statement left out) are drawn from the code of six rooms, as many of each.
Each is made in a copy of the tree, where the room's tests then run, the cheapest file first; tests
that alone take longer than `--slow` seconds (more of them on a busy machine) are left out. Prints
per room how many mutants were killed (a test failed), timed out (they compute for more than four
times as long, or a test for ten times `--slow`) and survived, and the survivors. A
survivor is either a missing assertion or a change that no one can see. It is a measurement and ends
with 0, or with 2 where the tests fail on the code as it is.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.commands import ROOT, tell

ROOMS = {  # the code, and the tests that are its own
    # Arrays are compared with the session of the same traffic where that is tested.
    "spec": (
        "spec",
        [
            *("tests/spec", "tests/analyzer/decode/test_framed.py"),
            "tests/analyzer/decode/test_stream.py",
            "tests/analyzer/simulated/test_device.py",  # devices that answer by a grammar
            "tests/test_transcripts.py",
        ],
    ),
    "oracle": ("conformance/oracle", ["tests/conformance/oracle", "tests/conformance/cases"]),
    "decode": (
        "analyzer/decode",
        [
            *("tests/analyzer/decode", "tests/analyzer/output/test_row_columns.py"),
            "tests/test_transcripts.py",
        ],
    ),
    "filters": ("analyzer/filters", ["tests/analyzer/filters", "tests/test_transcripts.py"]),
    "captures": ("captures", ["tests/captures"]),
    "runner": ("conformance/runner", ["tests/conformance/runner"]),
}
_PAIRS: tuple[tuple[type[ast.AST], str, type[ast.AST], str], ...] = (
    (ast.Lt, "<", ast.LtE, "<="),
    (ast.Gt, ">", ast.GtE, ">="),
    (ast.Eq, "==", ast.NotEq, "!="),
    (ast.In, "in", ast.NotIn, "not in"),
    (ast.Is, "is", ast.IsNot, "is not"),
    (ast.Add, "+", ast.Sub, "-"),
    (ast.Mult, "*", ast.FloorDiv, "//"),
    (ast.LShift, "<<", ast.RShift, ">>"),
    (ast.And, "and", ast.Or, "or"),
)
# As written, and what takes its place.
OPERATORS = {one: (old, new) for one, old, _, new in _PAIRS}
OPERATORS |= {other: (old, new) for _, new, other, old in _PAIRS}
OPERATORS[ast.BitAnd] = ("&", "|")  # `|` joins types too
NAMES = {"min": "max", "max": "min", "any": "all", "all": "any"}
SKIPPED_FIELDS = {"annotation", "returns", "decorator_list", "type_params"}
MEMORY = 4 << 30  # bytes of data: a mutant may loop for ever and hold on to everything
FOREIGN = 70  # exit code of a run that did not import the copy
QUIETLY = ["-q", "-pno:randomly", "-pno:cacheprovider", "--tb=no", "-rfE", "--hypothesis-seed=0"]
PYTEST = f"""\
import json, pathlib, resource, sys
resource.setrlimit(resource.RLIMIT_DATA, ({MEMORY}, {MEMORY}))
left_out, seconds = json.loads(sys.argv[1])
resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
import pytest
class Selection:
    def pytest_collection_modifyitems(self, items):
        items[:] = [item for item in items if item.nodeid not in left_out]
code = pytest.main(sys.argv[2:], [Selection()])
imported = sys.modules.get("bilprov")
if imported and not imported.__file__.startswith(str(pathlib.Path("src").absolute())):
    sys.exit({FOREIGN})
sys.exit(code)
"""


@dataclass(frozen=True, slots=True)
class Mutation:
    """One change of one file: the bytes from `start` to `end` give way to others."""

    file: str  # from the root of the tree
    operator: str
    start: int
    end: int
    replacement: bytes

    def applied(self, source: bytes) -> bytes:
        """The file's bytes with the change made."""
        return source[: self.start] + self.replacement + source[self.end :]

    def told(self, source: bytes) -> str:
        """`file:line: operator: before -> after`, the line on which the change begins."""
        number = source.count(b"\n", 0, self.start)
        lines = [text.split(b"\n")[number] for text in (source, self.applied(source))]
        before, after = (line.decode().strip() for line in lines)
        return f"{self.file}:{number + 1}: {self.operator}: {before} -> {after}"


def mutations(file: str, source: bytes) -> Iterator[Mutation]:
    """Every change that the operators can make to this file, in the order of its parse tree."""
    starts = [0]
    for row in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(row))

    def span(node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = starts[node.lineno - 1] + node.col_offset
        return begin, starts[node.end_lineno - 1] + node.end_col_offset

    def whole(kind: str, node: ast.expr | ast.stmt, text: str) -> Mutation:
        begin, end = span(node)
        kept_lines = b"\n" * (source.count(b"\n", begin, end) - text.count("\n"))
        return Mutation(file, kind, begin, end, text.encode() + kept_lines)

    def between(kind: str, left: int, right: ast.expr, old: str, new: str) -> Iterator[Mutation]:
        """The operator `old`, which stands after `left` and before an expression."""
        pattern = re.escape(old).replace(r"\ ", r"\s+").encode()
        gap = source[left : span(right)[0]]
        found = re.search(pattern, gap)
        if found and b"#" not in gap:
            yield Mutation(file, kind, left + found.start(), left + found.end(), new.encode())

    def swapped(
        kind: str, left: ast.expr, op: ast.AST, right: ast.expr, suffix: str = ""
    ) -> Iterator[Mutation]:
        if type(op) in OPERATORS:
            old, new = OPERATORS[type(op)]
            yield from between(kind, span(left)[1], right, old + suffix, new + suffix)

    for node in _code(ast.parse(source)):
        match node:
            case ast.Compare():
                operands = [node.left, *node.comparators]
                for left, op, right in zip(operands, node.ops, node.comparators, strict=False):
                    yield from swapped("comparison", left, op, right)
            case ast.BinOp():
                yield from swapped("arithmetic", node.left, node.op, node.right)
            case ast.BoolOp():
                for left, right in zip(node.values, node.values[1:], strict=False):
                    yield from swapped("and/or", left, node.op, right)
            case ast.UnaryOp(op=ast.Not()):
                yield from between("not removed", span(node)[0], node.operand, "not", "")
            case ast.Constant(value=bool()):
                yield whole("True/False", node, str(not node.value))
            case ast.Constant(value=int(number)):
                for other in (number + 1, number - 1):
                    yield whole("integer", node, str(other))
            case ast.Call(func=ast.Name(id=name)) if name in NAMES:
                yield whole("function", node.func, NAMES[name])
            case ast.Return(value=ast.expr() as value) if ast.unparse(value) != "None":
                yield whole("return value", value, "None")
            case ast.Expr() | ast.Assign() | ast.AugAssign():
                yield whole("statement deleted", node, "pass")
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.expr):
            yield from swapped("arithmetic", node.target, node.op, node.value, "=")
        conditions = [node.test] if isinstance(node, ast.If | ast.IfExp) else []
        conditions += node.ifs if isinstance(node, ast.comprehension) else []
        for test in conditions:
            if not (isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)):
                begin, end = span(test)
                yield whole("condition negated", test, f"not ({source[begin:end].decode()})")


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """This node and what stands in it, without what runs nowhere or says nothing."""
    match node:
        case ast.If(test=ast.Name(id="TYPE_CHECKING")) | ast.JoinedStr():
            return
        case ast.Expr(value=ast.Constant()):  # a docstring, or the dots of a protocol class
            return
        case ast.Assign(targets=[ast.Name(id="__all__")]):
            return
    yield node
    for name, value in ast.iter_fields(node):
        heading = isinstance(node, ast.ClassDef) and name != "body"
        if name not in SKIPPED_FIELDS and not heading:
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _code(child)


def draw(root: Path, room: str, count: int, seed: int) -> list[Mutation]:
    """So many different changes of a room's code; the same seed draws the same."""
    files = sorted((root / ROOMS[room][0]).rglob("*.py"))
    sources = {path.relative_to(root).as_posix(): path.read_bytes() for path in files}
    candidates = [m for file, source in sources.items() for m in mutations(file, source)]
    random.Random(f"{seed} {room}").shuffle(candidates)
    drawn: list[Mutation] = []
    for mutation in candidates:
        if len(drawn) == count:
            break
        if changes_the_tree(mutation, sources[mutation.file]):
            drawn.append(mutation)
    return drawn


def changes_the_tree(mutation: Mutation, source: bytes) -> bool:
    """Whether the changed file is Python, and other Python than before."""
    try:
        return ast.dump(ast.parse(mutation.applied(source))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


@dataclass(frozen=True, slots=True)
class Plan:
    """How a room's tests run: pytest's arguments, seconds of computing allowed, tests left out."""

    arguments: list[str]
    allowance: int = resource.RLIM_INFINITY
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one mutant: killed, timed out or survived."""

    room: str
    told: str
    outcome: str


def run_tests(tree: Path, plan: Plan) -> tuple[int, str]:
    """Run pytest on a copy; its exit code, and what it wrote."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src")}
    environment.pop("PYTEST_ADDOPTS", None)
    if plan.allowance > 0:  # what the first run compiled holds; a mutant is never kept
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
    limits = plan.left_out, plan.allowance
    with subprocess.Popen(
        [sys.executable, "-c", PYTEST, json.dumps(limits), *QUIETLY, *plan.arguments],
        cwd=tree,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            told, _ = process.communicate()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    if process.returncode == FOREIGN:
        raise RuntimeError("the tests did not import the copy of the tree")
    return process.returncode, told


def planned(tree: Path, room: str, options: argparse.Namespace) -> Plan:
    """Run a room's tests on the code as it is: which to keep, in which order, and for how long.

    Raises:
        RuntimeError: They fail.
    """
    before = _computed()
    code, told = run_tests(tree, Plan(["--durations=0", *ROOMS[room][1]]))
    if code:
        raise RuntimeError(f"{room}: its tests fail on the code as it is\n{told[-2000:]}")
    computed = _computed() - before
    took: defaultdict[str, float] = defaultdict(float)
    for seconds, test in re.findall(r"^([\d.]+)s (?:call|setup|teardown) +(.+)$", told, re.M):
        took[test] += float(seconds)
    slow = [test for test, seconds in took.items() if seconds > options.slow]
    cost = {path.relative_to(tree).as_posix(): 0.0 for path in _test_files(tree, room)}
    for test, seconds in took.items():
        if test not in slow:
            cost[test.partition("::")[0]] += seconds
    files = sorted(cost, key=lambda file: cost[file])
    each = 10 * options.slow  # one test that hangs: later than this it is not slow but stuck
    tell(f"{room}: tests take {computed:.0f} s of computing; {len(slow)} slow ones are left out")
    return Plan(["-x", f"--timeout={each}", *files], int(30 + 4 * computed), tuple(slow))


def _computed() -> float:
    """Seconds for which all runs so far have computed; a busy machine makes them no longer."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _test_files(tree: Path, room: str) -> Iterator[Path]:
    for name in ROOMS[room][1]:
        path = tree / name
        yield from sorted(path.rglob("test_*.py")) if path.is_dir() else [path]


def tried(tree: Path, room: str, mutation: Mutation, plan: Plan) -> Outcome:
    """Make the change in the copy, run the room's tests, and take the change back."""
    path = tree / mutation.file
    source, status = path.read_bytes(), path.stat()
    path.write_bytes(mutation.applied(source))
    try:
        code, told = run_tests(tree, plan)
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # its compiled form holds again
        shutil.rmtree(tree / ".hypothesis", ignore_errors=True)  # no mutant helps to kill the next
    outcome = "survived" if code == 0 else "killed"
    if code == -signal.SIGXCPU or "from pytest-timeout" in told:
        outcome = "timed out"
    return Outcome(room, mutation.told(source), outcome)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    add = parser.add_argument
    add("--seed", type=int, default=1, metavar="N", help="draws the mutants (1)")
    add("--count", type=int, default=100, metavar="N", help="mutants in all (100)")
    add("--room", action="append", choices=ROOMS, help="only this room; may be repeated")
    add("--slow", type=float, default=5, metavar="S", help="leave out tests that take longer (5)")
    return parser.parse_args()


def main() -> int:
    """Draw, try and count; returns 2 if a room's tests fail on the code as it is."""
    options, begin = _options(), time.monotonic()
    rooms = options.room or list(ROOMS)
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder).resolve() / "tree"
        unneeded = shutil.ignore_patterns(".git", ".venv", ".*_cache", ".hypothesis", "__pycache__")
        shutil.copytree(ROOT, tree, symlinks=True, ignore=unneeded)
        try:
            plans = {room: planned(tree, room, options) for room in rooms}
        except RuntimeError as error:
            tell(str(error))
            return 2
        outcomes: list[Outcome] = []
        share, rest = divmod(options.count, len(rooms))
        for number, room in enumerate(rooms):
            for mutation in draw(tree, room, share + (number < rest), options.seed):
                outcome = tried(tree, room, mutation, plans[room])
                outcomes.append(outcome)
                count = f"{len(outcomes)}/{options.count}"
                tell(f"{count} {outcome.outcome}: {outcome.told}")
    _summarise(rooms, outcomes, time.monotonic() - begin)
    return 0


def _summarise(rooms: list[str], outcomes: list[Outcome], seconds: float) -> None:
    count = Counter((outcome.room, outcome.outcome) for outcome in outcomes)
    for room in rooms:
        tell(
            f"{room}: {count[room, 'killed']} killed, {count[room, 'timed out']} timed out, "
            f"{count[room, 'survived']} survived"
        )
    caught = sum(outcome.outcome != "survived" for outcome in outcomes)
    tell(f"{caught} of {len(outcomes)} mutants caught in {seconds / 60:.0f} min; survivors:")
    for outcome in outcomes:
        if outcome.outcome == "survived":
            tell(outcome.told)


if __name__ == "__main__":
    sys.exit(main())
