"""What the tests share: the grammar and its Protocol, copies of it that differ, a tiny robot."""

from __future__ import annotations

import compileall
import gc
import importlib
import os
import pkgutil
import platform
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from random import Random

import pytest
from hypothesis import HealthCheck, settings

import benchmarks
import bilprov
import docs
import examples
from benchmarks.dispositions import usual_for_children
from bilprov.analyzer.decode import stream
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.chromium import Browser, Page, running
from tests.support.grammars import wide_grammar

# No test asserts a wall-clock time. What Hypothesis draws is the same in every run, so that a run
# fails for what was changed; with --whole it is another each time.
in_any_time = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("sample", in_any_time, max_examples=25, derandomize=True)
settings.register_profile("whole", in_any_time, max_examples=60)

# The tests follow no settings, and change no state, of whoever runs them.
os.environ["XDG_CONFIG_HOME"] = os.environ["XDG_STATE_HOME"] = os.devnull

# What `make quick` does without: other programs, and waiting in real time.
_NOT_QUICK = (
    (subprocess.Popen, "__init__", "starts a program"),
    (os, "fork", "starts a process"),
    (time, "sleep", "waits in real time"),
    (select, "select", "waits in real time"),
    (select, "poll", "waits in real time"),
)
_refusals: list[str] = []  # of the test that runs


def pytest_configure(config: pytest.Config) -> None:
    """Settle what Hypothesis draws, and compile the product before the first test.

    A command that a test lets write short files only would else leave a module's compiled file cut
    short, and no command could import it again.
    """
    settings.load_profile("whole" if config.getoption("--whole") else "sample")
    if config.getoption("--quick"):  # a refusal in a thread skips the test, and is no error
        ignored = "ignore::pytest.PytestUnhandledThreadExceptionWarning"
        config.addinivalue_line("filterwarnings", ignored)
    if not hasattr(config, "workerinput"):  # once, and not in each process of a run
        for room in ("src", "spec", "captures", "analyzer", "conformance"):
            compileall.compile_dir(ROOT / room, quiet=2)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--quick",
        action="store_true",
        help="skip each test at the moment that it starts a program or waits in real time",
    )

    parser.addoption(
        "--whole",
        action="store_true",
        help="every row of the tests that are sampled, and other random inputs in each run",
    )
    parser.addoption("--sample-seed", type=int, default=1, help="which rows a sample holds")
    parser.addoption(
        "--examples", type=int, help="how many inputs Hypothesis draws for each of its tests"
    )
    parser.addoption(
        "--rewrite-transcripts",
        action="store_true",
        help="write what commands print now into tests/transcripts, instead of comparing it",
    )


@pytest.fixture(autouse=True, scope="session")
def _usual_signals() -> None:
    """What tests start does not ignore the signals that these tests were started to ignore.

    Only where tests run: an xdist controller goes on handing down what nohup has set.
    """
    usual_for_children()


@pytest.fixture(autouse=True, scope="session")
def _nothing_is_left(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Temporary files, of programs that tests start too, are gone when the last test has run."""
    folder = str(tmp_path_factory.mktemp("temporary"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", folder)
        patch.setenv("TMPDIR", folder)
        yield
    shutil.rmtree(folder)


@pytest.fixture(autouse=True, scope="session")
def _quick(request: pytest.FixtureRequest) -> Iterator[None]:
    """With --quick, what is not quick skips the test that does it."""
    platform.platform()  # asks a program, once
    with pytest.MonkeyPatch.context() as patch:
        for owner, name, what in _NOT_QUICK if request.config.getoption("--quick") else ():

            def refused(*_: object, what: str = what, **__: object) -> None:
                _refusals.append(what)
                pytest.skip(f"not quick: {what}")

            patch.setattr(owner, name, refused)
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Skip what was refused something, also where a thread or a command took the refusal."""
    _refusals.clear()
    try:
        yield
    finally:
        if _refusals:
            pytest.skip(f"not quick: {_refusals[0]}")


def _sampled(items: list[pytest.Item], seed: int) -> list[pytest.Item]:
    """The items without those that a seeded sample of their test's rows leaves out."""
    rows: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sample"):
            rows.setdefault(item.nodeid.partition("[")[0], []).append(item)
    left_out: set[pytest.Item] = set()
    for name, same in rows.items():
        size: int = same[0].get_closest_marker("sample").args[0]  # type: ignore[union-attr]
        same.sort(key=lambda item: item.nodeid)
        kept = Random(f"{seed} {name}").sample(same, min(size, len(same)))
        left_out |= set(same) - set(kept)
    return [item for item in items if item not in left_out]


def _draws(item: pytest.Item, examples: int) -> None:
    """A test by Hypothesis draws so many inputs, also where its own settings say how many."""
    test = item.obj  # type: ignore[attr-defined]
    own = test._hypothesis_internal_use_settings
    test._hypothesis_internal_use_settings = settings(own, max_examples=examples)


@pytest.hookimpl(trylast=True)  # after pytest-randomly, whose order is kept
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests with very many rows run a seeded sample of them, unless --whole is given.

    Tests that wait are begun first, by every other worker: the others compute meanwhile.

    xdist gives each worker a piece of the list, and what is left at the end to whoever is free.
    """
    if not config.getoption("--whole"):
        items[:] = _sampled(items, config.getoption("--sample-seed"))
    if examples := config.getoption("--examples"):
        for item in items:
            if item.get_closest_marker("hypothesis"):
                _draws(item, examples)
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    waiting = [item for item in items if item.get_closest_marker("waits")]
    waiting.sort(key=lambda item: not item.get_closest_marker("timeout"))  # the longest first
    others = iter([item for item in items if not item.get_closest_marker("waits")])
    size, takers = len(items) // workers, (workers + 1) // 2
    items.clear()
    for worker in range(workers):
        mine = [] if worker % 2 else waiting[worker // 2 :: takers]
        items += mine
        items += islice(others, max(0, size - len(mine)))
    items += others


def pytest_collection_finish() -> None:
    """Import all modules, and keep what is there.

    Hypothesis also draws the constants in all modules of ours that are imported, and would draw
    others in each process and after each test that imports some. The garbage collector need not
    walk for ever over what stays.
    """
    for package in (bilprov, benchmarks, docs, examples):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


HORN = """\
    9: "Horn"
    / Instruction(
        "sound" / Ranged(Byte, 0, 3) * "which of the four sounds, 0 is silence",
        document="Tuta",
    )
    * "Sounds the horn.",
"""


@pytest.fixture(scope="session")
def grammar_text() -> str:
    """The text of the kit's own grammar."""
    return (ROOT / "spec" / "grammar.py").read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def protocol(grammar_text: str) -> Protocol:
    return load(grammar_text, "grammar.py")


@pytest.fixture(scope="session")
def horn_text(grammar_text: str) -> str:
    """A copy of the grammar with one literal entry more: instruction 9 "Horn", one byte 0 to 3."""
    end = "}\n\nFRAME ="
    assert grammar_text.count(end) == 1
    return grammar_text.replace(end, HORN + end)


@pytest.fixture(scope="session")
def horn(horn_text: str) -> Protocol:
    return load(horn_text, "horn.py")


@pytest.fixture(scope="session")
def wide(grammar_text: str) -> Protocol:
    """A grammar with wide and signed fields, and a header of 3 + 5 bits."""
    return load(wide_grammar(grammar_text), "wide.py")


@pytest.fixture(scope="session", params=["protocol", "horn", "wide"])
def each_protocol(request: pytest.FixtureRequest) -> Protocol:
    """The kit's own grammar, the one with a Horn, and the wide one, in turn."""
    found: Protocol = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="module")
def columns_at_once() -> Iterator[None]:
    """Columns decode any number of bytes from the first on, which is else not worth the trouble."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream, "LEAST", 0)
        yield


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Headless Chromium."""
    with running(tmp_path_factory.mktemp("chromium")) as started:
        yield started


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """A tab of it, wide and light."""
    with browser.page() as tab:
        tab.size(1280)
        tab.scheme("light")
        yield tab
