"""Fuzzing: a small seeded run and the corpus end without a failure; each way to fail is noticed."""

from __future__ import annotations

import resource
from collections.abc import Callable, Hashable
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest

from benchmarks.fuzz import engine
from benchmarks.fuzz.capture_mutator import mutated_capture
from benchmarks.fuzz.engine import (
    CORPUS,
    Endless,
    Failed,
    Refused,
    Target,
    Wrong,
    corpus,
    outcome_of,
    run,
    watched,
)
from benchmarks.fuzz.measure import measure
from benchmarks.fuzz.mutators import mutated_bytes
from benchmarks.fuzz.targets import TARGETS
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture

INPUTS = 20  # of each target


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_takes_or_refuses_what_is_damaged(name: str) -> None:
    row = run(TARGETS[name], INPUTS, seed=1)

    assert [finding.said for finding in row.findings] == []
    assert (row.inputs, row.crashes) == (INPUTS, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_takes_its_seeds(name: str) -> None:
    target = TARGETS[name]
    test = target.prepare()

    with watched():
        outcomes = [outcome_of(target, test, data) for data in target.seeds()]

    assert [one for one in outcomes if isinstance(one, Failed)] == []
    assert any(not isinstance(one, Refused) for one in outcomes)


PAST = [(name, path.name) for name in TARGETS for path in corpus(name)]


@pytest.mark.parametrize(("name", "file"), PAST)
def test_what_a_target_once_failed_on_fails_no_more(name: str, file: str) -> None:
    target = TARGETS[name]

    with watched():
        outcome = outcome_of(target, target.prepare(), (CORPUS / name / file).read_bytes())

    assert not isinstance(outcome, Failed), outcome.said


def test_the_corpus_is_small_and_belongs_to_targets() -> None:
    files = [path for path in CORPUS.rglob("*") if path.is_file()]

    assert {path.parent.name for path in files} <= TARGETS.keys()
    assert sum(path.stat().st_size for path in files) < 100_000
    assert len(PAST) == len(files)


# -- the engine -----------------------------------------------------------------------------------


def made(test: Callable[[bytes], Hashable], *refuses: type[Exception]) -> Target:
    return Target("made", "", lambda: test, refuses, lambda: [b"some bytes"], mutated_bytes, 1)


def at_a_space(data: bytes, act: Callable[[], object]) -> Hashable:
    """Come to grief at any input with a space."""
    if b" " in data:
        act()
    return len(data)


def spin() -> None:
    while True:
        pass


def grow() -> None:
    bytearray(2 * engine.MEMORY)


def wrong() -> None:
    raise Wrong("two ways differ")


def key_error() -> None:
    raise KeyError("name")


def leave() -> None:
    raise SystemExit(0)


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (key_error, "KeyError"),
        (leave, "SystemExit"),
        (wrong, "Wrong: two ways differ"),
        (spin, "Endless"),
        (grow, "MemoryError"),
    ],
)
def test_each_way_to_fail_is_noticed_and_the_input_shortened(
    monkeypatch: pytest.MonkeyPatch, act: Callable[[], object], error: str
) -> None:
    if act is spin:
        monkeypatch.setattr(engine, "CPU_SECONDS", 0.02)
        monkeypatch.setattr(engine, "_TRIES", 5)
    row = run(made(lambda data: at_a_space(data, act), ValueError), 20, seed=1)

    (finding,) = row.findings
    assert finding.failure.error == error
    assert row.crashes == finding.times > 0
    if act is not spin:  # each try takes its time
        assert finding.data == b" "


def test_an_exception_that_a_target_may_raise_is_no_failure() -> None:
    def refuse() -> None:
        raise ValueError("no")

    row = run(made(lambda data: at_a_space(data, refuse), ValueError), 20, seed=1)

    assert (row.crashes, row.findings) == (0, [])
    assert 0 < row.refused < 20


def test_no_handler_of_exceptions_hides_endless_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "CPU_SECONDS", 0.02)

    def stubborn(data: bytes) -> None:
        try:
            spin()
        except Exception:
            return

    target = made(stubborn)
    with watched():
        outcome = outcome_of(target, stubborn, b"")

    assert isinstance(outcome, Failed)
    assert outcome.failure.error == Endless.__name__


def test_limits_end_with_the_run() -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)

    with watched():
        assert resource.getrlimit(resource.RLIMIT_AS) != before

    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_the_same_seed_gives_the_same_inputs() -> None:
    seen: dict[int, list[list[bytes]]] = {}
    for seed in (1, 1, 2):
        inputs: list[bytes] = []
        run(made(inputs.append), 50, seed=seed)  # type: ignore[arg-type]
        seen.setdefault(seed, []).append(inputs)

    assert seen[1][0] == seen[1][1] != seen[2][0]


def test_every_input_is_shared_out() -> None:
    chosen = [made(len), made(len), made(len)]

    rows = measure(100, 1, chosen)

    assert [row.inputs for row in rows] == [33, 33, 34]
    assert sum(row.crashes for row in rows) == 0


@pytest.mark.slow
def test_captures_are_damaged_where_their_checksums_still_fit(tmp_path: Path) -> None:
    pool = TARGETS["reader"].seeds()
    random, whole, file = Random(1), 0, tmp_path / "damaged.mcap"
    for _ in range(60):
        file.write_bytes(mutated_capture(random, pool))
        with suppress(CaptureError):
            whole += not open_capture(file).damage and file.read_bytes() not in pool

    assert whole > 10
