"""The harms to lines, memory and grammars: a few runs hold, and what is planted is seen."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from random import Random
from typing import Any

import pytest

from benchmarks.noise import Trial, noisy_run, simulated
from benchmarks.torture import floods, grammars, matrices, noise, unplugged_taps, unplugs
from benchmarks.torture.harm import Row
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk


def rows_of(module: Any, runs: int, seed: int = 1) -> list[Row]:
    told: list[int] = []
    rows: list[Row] = module.HARM.measure(runs, seed, told.append)
    assert sum(told) == runs
    return rows


def wrong(rows: list[Row]) -> list[str]:
    return [sentence for row in rows for sentence in row.wrong]


# -- ports that are unplugged ---------------------------------------------------------------------

# In a script, a program that does as the commands do and breaks one promise.
PLANTED = {
    "a traceback": ("raise ValueError", "a traceback"),
    "an exit that means all was well": ("exit(0)", "exit 0"),
    "no sentence": ("exit(2)", "exit 2 without a sentence"),
}
DRIVES = """
import sys, time
from bilprov.analyzer.transport.ports import open_port
port = open_port(sys.argv[1])
try:
    for frame in sys.argv[2:]:
        port.write(bytes.fromhex(frame))
    while True:
        port.read()
        time.sleep(0.01)
except Exception:
    pass
"""


def plant(
    monkeypatch: pytest.MonkeyPatch, script: str, *, late: float, waits: bool = False
) -> None:
    """Have a script as the command named planted; it sets the robot moving."""
    frames = [item for item in unplugs.items(pause="") if item]
    start, count = [sys.executable, "-c", script], len(bytes.fromhex("".join(frames)))
    driver = unplugs.Driver(lambda port, probe, folder: [*start, port, *frames], count, waits)
    monkeypatch.setitem(unplugs.DRIVERS, "planted", driver)
    monkeypatch.setattr(unplugs, "_LATE", (late,))


@pytest.mark.waits
@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", unplugs.KINDS)
def test_a_command_whose_port_is_unplugged_ends_or_goes_on_as_it_must(name: str, seed: int) -> None:
    run = unplugs.KINDS[name](seed)

    assert run.wrong == ()
    assert run.back <= run.cut


@pytest.mark.waits
@pytest.mark.parametrize("name", PLANTED)
def test_a_command_that_ends_otherwise_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    last, words = PLANTED[name]
    plant(monkeypatch, DRIVES + last, late=0.0)

    run = unplugs.driven("planted", 2)

    assert run.cut
    assert any(words in sentence for sentence in run.wrong), run


@pytest.mark.waits
def test_a_robot_that_is_left_moving_at_a_port_that_is_back_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant(monkeypatch, f"{DRIVES}time.sleep(3)\nexit('the port is gone')", late=0.3, waits=True)

    run = unplugs.driven("planted", 1)

    assert run.back
    assert any("the robot is left moving" in sentence for sentence in run.wrong), run


@pytest.mark.waits
def test_a_byte_that_is_not_in_the_capture_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def forgetful(path: Any) -> Iterator[Any]:
        messages = list(open_capture(path))
        first = next(message for message in messages if isinstance(message, Chunk))
        return (message for message in messages if message is not first)

    monkeypatch.setattr(unplugged_taps, "open_capture", forgetful)

    run = unplugged_taps.bridged(1)

    assert any("bytes were said" in sentence for sentence in run.wrong), run


# -- devices that flood, and memory ---------------------------------------------------------------


@pytest.mark.waits
@pytest.mark.slow
@pytest.mark.sample(1)
@pytest.mark.parametrize(("name", "peer"), floods.PAIRS, ids=lambda word: word.replace(" ", "-"))
def test_a_command_at_a_bad_device_stays_small(name: str, peer: str) -> None:
    ended = floods.flooded(name, peer, 1)

    assert not floods.wrong_with(ended), ended


@pytest.mark.waits
@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("x = bytearray(b'1' * 160_000_000)", "MB, allowed are 150 MB"),
        ("import time; time.sleep(600)", "it took longer than 2 s"),
        ("raise ValueError", "a traceback"),
        ("exit(2)", "exit 2 without a sentence"),
        ("exit(9)", "exit 9"),
    ],
)
def test_a_command_that_grows_hangs_or_breaks_is_seen(
    script: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = floods.Command(lambda port, folder: [sys.executable, "-c", script])
    monkeypatch.setattr(floods, "COMMANDS", {"planted": planted})
    monkeypatch.setattr(floods, "PAIRS", [("planted", next(iter(floods.PEERS)))])
    monkeypatch.setattr(floods, "_PATIENCE", 2 if "600" in script else 60)

    (row,) = rows_of(floods, 1)

    assert any(words in sentence for sentence in row.wrong), row


# -- hostile grammars -----------------------------------------------------------------------------


@pytest.mark.waits
@pytest.mark.slow
def test_hostile_grammars_are_refused_or_used_in_little_memory() -> None:
    rows = rows_of(grammars, 50)

    assert not wrong(rows)
    assert [row.times for row in rows][2:] == [50, sum(row.times for row in rows[:3])]


def test_the_same_seed_gives_the_same_mutants() -> None:
    first, again, other = (list(grammars.texts(3, seed)) for seed in (1, 1, 2))

    assert first == again
    assert [text for *_, text in first[-3:]] != [text for *_, text in other[-3:]]


@pytest.mark.parametrize("said", ["", "an \x1b[2J escape", "x" * 500, KeyError("x"), 3.0])
def test_a_grammar_that_is_not_refused_in_a_sentence_is_seen(
    said: str | Exception | float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loaded_or_said(text: str) -> str:
        if isinstance(said, Exception):
            raise said
        return "a sentence" if isinstance(said, float) else said

    monkeypatch.setattr(grammars, "loaded_or_said", loaded_or_said)
    if isinstance(said, float):  # so long it computes
        times = iter([0.0, said])
        monkeypatch.setattr(grammars.time, "process_time", lambda: next(times))

    assert grammars.read("", Random(1))["wrong"]


@pytest.mark.waits
def test_a_reader_of_grammars_that_grows_or_ends_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grammars, "_MEMORY", 1_000_000)
    assert any("MB, allowed are 1 MB" in sentence for sentence in wrong(rows_of(grammars, 1)))

    monkeypatch.setattr(grammars, "_PATIENCE", 0.01)
    assert any("it took longer than" in sentence for sentence in wrong(rows_of(grammars, 1)))


# -- noise ----------------------------------------------------------------------------------------


def _told(trial: Trial, code: int) -> tuple[int, str]:
    return code, "planted"


@pytest.mark.slow
def test_the_suite_over_bad_lines_judges_nobody_wrongly(monkeypatch: pytest.MonkeyPatch) -> None:
    found = cycle(["speed-starts-it", "code-in-ascii", "ok-to-unknown-id"])  # at level smoke

    def known(seeds: Iterable[int], rates: Sequence[float]) -> list[Trial]:
        trials = simulated(seeds, rates)
        return [replace(trial, fault=next(found)) if trial.fault else trial for trial in trials]

    monkeypatch.setattr(noise, "simulated", known)
    monkeypatch.setattr(noise, "noisy_run", partial(noisy_run, level="smoke"))

    rows = rows_of(noise, len(noise.RATES) * 4)

    assert not wrong(rows)
    assert [row.times for row in rows] == [2] * 12


@pytest.mark.parametrize(
    ("code", "expected"),
    [(0, "0 good robots failed, 1 faulty ones passed"), (1, "1 good robots failed, 0 faulty")],
)
def test_a_wrong_verdict_is_seen(code: int, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise, "noisy_run", partial(_told, code=code))

    (row,) = rows_of(noise, 1)

    assert row.lost.startswith(expected)
    assert len(row.wrong) == 1
    assert row.wrong[0].endswith(f"exit {code}: planted")


def test_every_line_meets_every_fault_at_every_rate_in_its_turn() -> None:
    trials = simulated(range(144), noise.RATES)

    met = {(trial.line, trial.rate, trial.fault) for trial in trials if trial.fault}
    assert len(met) == 144


# -- matrices -------------------------------------------------------------------------------------


@pytest.mark.waits
@pytest.mark.parametrize(
    "tests",
    [("tests/no_such_file.py",), ("-k", "no_such_test", "tests/test_torture_page.py")],
    ids=["no file", "no test"],
)
def test_a_matrix_of_which_nothing_was_run_is_seen(
    tests: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matrices, "PLACES", {"a fault": tests})

    assert "after 0 tests" in wrong(matrices.HARM.measure(1, 1, lambda done: None))[0]
