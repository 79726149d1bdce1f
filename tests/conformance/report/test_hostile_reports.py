"""Hostile reports: whatever a file holds, `merge` and `report` say one sentence."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from bilprov.__main__ import main
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.report.json_report import as_json
from bilprov.spec.protocol import Protocol

SHARDS = [
    *([0, 0], [1], ["a", "b"], [9, 2], [-1, 3], 1e9, [1e9, 1e9], [None, 2], [1, None], "1/2", ""),
    *({}, {"0": 1, "1": 2}, [], [1, 2, 3], True, [True, True], [[1], [2]], [0, 3], 1 << 200, 3),
]
HOSTILE = [
    *SHARDS, None, False, 0, -1, 1e308, -1e308, 1 << 64, "x", "\0\x1b[31m\u202e", "a" * 300, [None],
    {"a": None}, {"": [{}]}, "NaN", "../..", ["a"],
]  # fmt: skip
Path_ = tuple[str | int, ...]


@pytest.fixture(scope="module")
def shard(protocol: Protocol) -> dict[str, Any]:
    """What a shard with a failure, told by few cases, wrote, and what only other runs write."""
    device = Simulator(protocol, fault_bank(protocol)["led-order-reversed"])
    options = Options(only=("valid/LED/1",), shard=(1, 1))
    document = json.loads(as_json(conform(device, grammar=protocol, options=options)))
    cases = {case["verdict"]: case for case in document["cases"]}
    for case in cases.values():
        del case["log"][2:]
    counts = dict.fromkeys(document["counts"], 0) | dict.fromkeys(cases, 1)
    document |= {"cases": list(cases.values()), "counts": counts, "dropped": {"valid": 1}}
    document["link"]["kind"] = "port"
    document["expected_failures"] = {"file": "x", "expected": 0, "unexpected": 1, "stale": ["y"]}
    return dict(document)


def ended(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str]:
    """The command's exit code in this process, and what it said on standard error."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    return stop.value.code, capsys.readouterr().err


def commands(folder: Path) -> Iterator[tuple[str, ...]]:
    file = str(folder / "shard.json")
    pages = [f"--{kind}={folder / kind}" for kind in ("html", "junit", "markdown")]
    yield "merge", file, "--json", str(folder / "whole.json")
    yield "report", file
    yield "report", file, file, *pages


def places(value: object, path: Path_ = ()) -> Iterator[Path_]:
    """The way to each value, of lists to the first three."""
    yield path
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from places(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value[:3]):
            yield from places(inner, (*path, index))


def with_value(document: Any, path: Path_, value: object) -> Any:
    """A copy with another value at that place."""
    if not path:
        return value
    changed = deepcopy(document)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


@pytest.mark.parametrize("value", SHARDS, ids=str)
def test_a_shard_that_there_cannot_be_is_one_sentence(
    shard: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], value: object
) -> None:
    document = with_value(shard, ("options", "shard"), value)
    (tmp_path / "shard.json").write_text(json.dumps(document))

    for words in commands(tmp_path):
        code, told = ended(capsys, *words)

        assert (code, told.count("\n")) == (2, 1), told
        assert "shard" in told


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("options", "level"), "none such"),
        (("options", "soak"), 1 << 60),
        (("profile", "readings"), [1]),
        (("cases", 0, "received"), [{"hex": "00", "t": 1e308}]),
        (("expected_failures", "stale"), 3),
    ],
)
def test_merge_refuses_what_it_cannot_read(
    shard: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    path: Path_,
    value: object,
) -> None:
    (tmp_path / "shard.json").write_text(json.dumps(with_value(shard, path, value)))

    code, told = ended(capsys, *next(commands(tmp_path)))

    assert (code, told.count("\n")) == (2, 1), told


def test_whatever_value_stands_anywhere_there_is_no_traceback(
    shard: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn, everywhere = random.Random(4), list(places(shard))
    whole = [path for path in everywhere if path[:1] != ("cases",)]
    for number in range(60):
        path = drawn.choice(whole if number % 2 else everywhere)
        value = drawn.choice(HOSTILE)
        (tmp_path / "shard.json").write_text(json.dumps(with_value(shard, path, value)))
        for words in commands(tmp_path):
            code, told = ended(capsys, *words)

            assert code in (0, 1, 2, 3), (path, value)
            assert "Traceback" not in told, (path, value, told)
            assert told.startswith("bilprov: ") or code != 2, (path, value, told)


def test_merge_shows_nothing_that_controls_the_terminal(
    shard: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = with_value(shard, ("device",), "\x1b]0;gone\x07")
    (tmp_path / "shard.json").write_text(json.dumps(document))

    with pytest.raises(SystemExit):
        main(next(commands(tmp_path)))

    told = capsys.readouterr().out
    assert "gone" in told
    assert not {"\x1b", "\x07"} & set(told)
