"""Ports are unplugged while commands use them, and in half of the runs plugged in again.

The moment, the pause and which port it is are drawn by the seed. What taps and a bridge must keep
stands in `unplugged_taps`; a command that drives must end as its help says, within its time, and
leave no robot moving at a port that was there again for it.
"""

from __future__ import annotations

import json
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from benchmarks.adapter import Adapter
from benchmarks.commands import bilprov_words, started
from benchmarks.torture.exits import items, replay_to
from benchmarks.torture.harm import Harm, Row, tracked
from benchmarks.torture.robots import served
from benchmarks.torture.unplugged_taps import TAPPED, Unplugged
from bilprov.analyzer.replay.comparison import UNANSWERED_STOPS
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import CaseMark, Line
from bilprov.conformance.recheck import recheck

_PATIENCE = 90.0  # s until a command must have ended
_AWAY = (0.05, 1.0)  # s
_LATE = (0.0, 0.0, 0.05, 0.3)  # s after its bytes at which the port is unplugged
_GONE = 1.0  # s that a command which waits for ever does so before it is interrupted


class Driver(NamedTuple):
    """A command that drives: its words for a port, a probe and a folder; the least that it sends.

    That is in `bytes`; `conform` sends up to a tenth more, depending on the times of the line.
    `waits` tells that it goes on where the port is there again.
    """

    words: Callable[[str, str, Path], list[str]]
    bytes: int
    waits: bool = False
    ever: bool = False
    """Whether it waits until it is interrupted."""


def _send(*more: str) -> Callable[[str, str, Path], list[str]]:
    return lambda port, probe, folder: bilprov_words(
        "send", port, *items(pause="pause=100"), "--yes", *more
    )


def _conform(*more: str) -> Callable[[str, str, Path], list[str]]:
    return lambda port, probe, folder: bilprov_words(
        *("conform", port, "--probe", probe, "--yes", "--level", "smoke", *more),
        *("--json", str(folder / "report.json"), "--record", str(folder / "run.mcap")),
    )


DRIVERS = {
    "send --wait": Driver(_send("--wait"), 60, waits=True, ever=True),
    "send": Driver(_send(), 60),
    "conform --reconnect": Driver(_conform("--reconnect", "5"), 4500, waits=True),
    "conform": Driver(_conform(), 4500),
    "replay --to": Driver(lambda port, probe, folder: replay_to(port, folder), 170),
}
"""The commands that drive; the taps are in `unplugged_taps.TAPPED`."""


@dataclass(frozen=True, slots=True)
class Driven:
    """How a command that drives ended: None as its code is that it did not end."""

    code: int | None
    told: str
    cut: bool
    """Whether the port was unplugged before the command ended."""
    back: bool
    """Whether the port was plugged in again while the command ran."""
    whole: bool
    """Whether all that the command sends was sent: it may have been done when the port went."""
    moving: bool
    folder: Path


def driven(name: str, seed: int) -> Unplugged:
    """Run a command that drives over an adapter, unplug that, and see what comes of it."""
    command, draw = DRIVERS[name], Random(f"{seed} {name}")
    after, late = draw.randint(1, command.bytes), draw.choice(_LATE)
    away = draw.uniform(*_AWAY) if seed % 2 else None
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        line, probe = stack.enter_context(served())
        adapter = stack.enter_context(Adapter(folder / "port", line, [after], away, late))
        errors = stack.enter_context(tempfile.TemporaryFile())
        words = command.words(str(folder / "port"), probe.name, folder)
        process = stack.enter_context(started(words, stderr=errors.fileno()))
        code: int | None = None
        try:
            if command.ever and away is None:
                while process.poll() is None and not adapter.unplugged.wait(0.05):
                    pass
                time.sleep(_GONE)
                process.send_signal(signal.SIGINT)
            code = process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
        cut, back = adapter.unplugged.is_set(), adapter.plugged_again.is_set()
        time.sleep(0.1)  # for what has been sent to arrive
        errors.seek(0)
        said = errors.read().decode(errors="replace")
        whole = adapter.passed >= command.bytes
        run = Driven(code, said, cut, back, whole, probe.moving, folder)
        wrong = [*_ended_wrong(command, run), *(_judged_wrong(run) if "conform" in name else ())]
    moment = f"seed {seed}, after {after} bytes and {late:g} s, away {away or 'for good'}"
    return Unplugged(cut, back, run.moving, tuple(f"{moment}: {one}" for one in wrong))


def _ended_wrong(command: Driver, run: Driven) -> list[str]:
    """What is wrong with how a command ended."""
    last = run.told.strip()[-300:]
    if run.code is None:
        return [f"it did not end in {_PATIENCE:g} s: {last}"]
    if "Traceback" in run.told:
        return [f"a traceback: {last}"]
    allowed = {2}
    if not run.cut or (run.whole and not run.moving):
        allowed = {0, 1, 2, 3} if run.cut else {0, 3}
    elif command.ever:  # with 2 where nobody had answered yet
        allowed = {1, 2}
    elif command.waits and run.back:
        allowed = {2, 3}  # with 2 before the first case
    if UNANSWERED_STOPS in run.told:
        allowed = {1}
    wrong = []
    if run.code not in allowed:
        wrong.append(f"exit {run.code}, allowed is {sorted(allowed)}: {last}")
    if run.code and not last:
        wrong.append(f"exit {run.code} without a sentence")
    if run.moving and run.back and command.waits:
        wrong.append(f"the robot is left moving, exit {run.code}: {last}")
    return wrong


def _judged_wrong(run: Driven) -> list[str]:
    """What is wrong with the report and the capture of a run that was cut."""
    if run.code is None:
        return []
    if not (run.folder / "report.json").exists():
        return ["there is no report"]
    report: dict[str, Any] = json.loads((run.folder / "report.json").read_bytes())
    path = str(run.folder / "run.mcap")
    wrong = [f"recheck differs: {one}" for one in recheck(path).differences]
    verdicts = {case["id"]: case["verdict"] for case in report["cases"]}
    under_way = ""
    for message in open_capture(path):
        if isinstance(message, CaseMark):
            under_way = message.id if message.phase == "begin" else ""
        if isinstance(message, Line) and message.event == "unplugged" and under_way:
            verdict = verdicts.get(under_way)
            if verdict not in ("inconclusive", "skipped", "error"):
                wrong.append(f"{under_way} was cut, and is {verdict}")
    if report["counts"]["fail"]:
        wrong.append(f"{report['counts']['fail']} cases of a good robot failed")
    if run.code == 3 and run.cut and report["ended"] is not None:
        wrong.append(f"exit 3, and it ended: {report['ended']}")
    if run.code == 2 and report["ended_by"] != "error":
        wrong.append(f"exit 2, and it ended by {report['ended_by']!r}")
    return wrong


KINDS: dict[str, Callable[[int], Unplugged]] = {
    **TAPPED,
    **{name: partial(driven, name) for name in DRIVERS},
}
"""Each command with what unplugs it in one run."""


def _measure(runs: int, seed: int) -> list[Row]:
    """Unplug each command so often, two at a time; a row for each."""
    came: dict[str, list[Unplugged]] = {name: [] for name in KINDS}
    rows = list(product(range(seed, seed + runs), KINDS))
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(lambda row: KINDS[row[1]](row[0]), rows)
        for (_, name), one in tracked(zip(rows, done, strict=True), len(rows)):
            came[name].append(one)
    return [_row(name, runs_of) for name, runs_of in came.items()]


def _row(name: str, came: list[Unplugged]) -> Row:
    cut, back = sum(one.cut for one in came), sum(one.back for one in came)
    moving = sum(one.moving for one in came if one.cut)
    robots = (
        ""
        if name in TAPPED
        else f"; {moving} robots moving at the end, whose port was gone: no byte could reach them"
    )
    return Row(
        f"the port of `{name}` unplugged",
        len(came),
        f"{cut} unplugged while it ran, {back} of them plugged in again meanwhile{robots}",
        tuple(sentence for one in came for sentence in one.wrong),
    )


HARM = Harm("unplugs", "ports are unplugged, and plugged in again", 100, _measure)
