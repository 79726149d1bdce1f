"""Runs of the suite over a bad line: no false fail of a good device, no wrong pass of a bad one.

`python -m benchmarks.noise [--seeds N] [--jobs N] [--level NAME] [--rate R ...] [--board]`: seeded
runs at level standard in virtual time. The devices are the simulator and faults of its bank, with
one bad byte in ten thousand, or the rates given in turn; with --board they are the firmware and its
planted bugs under simavr, over a line that drops 1e-4, flips 1e-5 and holds each byte up for 5 ms.
Prints a line per run that went otherwise than it may, then a table; ends with 1 if there was one.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

from rich.console import Console
from rich.progress import track

from benchmarks.noisy_device import NoisyDevice
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.relay import Noise
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.boards.simavr import SimavrBoard
from bilprov.conformance.dut.link import Device
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict

RATE = 1e-4
LINES: dict[str, Callable[[float], Noise]] = {
    "flipped": lambda rate: Noise(flipped=rate),
    "dropped": lambda rate: Noise(dropped=rate),
    "doubled": lambda rate: Noise(doubled=rate),
    "mixed": lambda rate: Noise(rate / 3, rate / 3, rate / 3),
}
"""Kinds of line by the share of their bytes that are hurt."""
FAR = Noise(dropped=1e-4, flipped=1e-5)
DELAY = 5_000_000  # ns
FAULTS = 12  # of the bank, evenly spread
ROOT = Path(__file__).resolve().parent.parent
FIRMWARE = ROOT / "firmware"


@dataclass(frozen=True, slots=True)
class Trial:
    """One run to make: what is wrong with the device ("" for nothing), its line, the seed."""

    fault: str
    line: str
    seed: int
    rate: float = RATE
    firmware: Path | None = None  # None for the simulator

    @property
    def expected(self) -> tuple[int, int]:
        """The exit codes that it may end in: a wrong pass or a false fail is none of them."""
        return (1, 3) if self.fault else (0, 3)

    def device(self) -> Device:
        """The device behind its line."""
        protocol = load_protocol()
        if self.firmware:
            return NoisyDevice(SimavrBoard(self.firmware), FAR, self.seed, DELAY)
        robot = Simulator(protocol, fault_bank(protocol)[self.fault] if self.fault else None)
        return NoisyDevice(robot, LINES[self.line](self.rate), self.seed)


def noisy_run(trial: Trial, level: str = "standard") -> tuple[int, str]:
    """Run one device over its line: the exit code, and what failed or ended the run."""
    try:
        # A faulty device has failed with its first failure.
        options = Options(level=level, seed=trial.seed, fail_fast=bool(trial.fault))
        report = conform(trial.device(), options=options)
    except Exception as error:  # a kit that breaks is what is looked for
        return 2, f"{type(error).__name__}: {error}"
    bad = [r for r in report.results if r.verdict is Verdict.FAIL]
    told = [f"{r.id}: {next(a.reason for a in r.axes.values() if a.reason)}" for r in bad[:4]]
    return report.exit, "; ".join(told) or report.unusable or report.ended_by or ""


def simulated(seeds: Iterable[int], rates: Sequence[float] = (RATE,)) -> list[Trial]:
    """The reference over each line, once for each seed; as often the faulty devices.

    The rates take turns, each with every kind of line.
    """
    bank = [fault.name for fault in fault_bank(load_protocol()).values() if not fault.needs]
    faults = bank[:: len(bank) // FAULTS][:FAULTS]
    pairs = list(product(rates, LINES))
    trials = []
    for number, seed in enumerate(seeds):
        rounds, place = divmod(number, len(pairs))
        rate, line = pairs[place]
        fault = faults[(place + rounds) % FAULTS]  # another one for this line in each round
        trials += [Trial(what, line, seed, rate) for what in ("", fault)]
    return trials


def boards(seeds: int, built: Callable[[str], Path], bugs: list[str]) -> list[Trial]:
    """The clean firmware `seeds` times; as often firmware with a bug, each bug in its turn.

    `built` makes the ELF file of a bug, "" for none.
    """
    planted = [bugs[seed % len(bugs)] for seed in range(seeds)]
    return [
        Trial(bug, "far", seed, firmware=built(bug))
        for bugs_of in ([""] * seeds, planted)
        for seed, bug in enumerate(bugs_of)
    ]


def _built(folder: Path, bug: str) -> Path:
    out = folder / (bug or "clean")
    if not out.exists():
        words = ["make", "-s", "-C", str(FIRMWARE), f"OUT={out}", f"BUGS={bug and '-D' + bug}"]
        words.append(f"BILPROV={sys.executable} -m bilprov")
        subprocess.run(words, check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
    return out / "uno.elf"


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run them all; returns 1 if one went otherwise than it may."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=50, metavar="N", help="runs of each kind (50)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--level", default="standard", help="the suite's level (standard)")
    parser.add_argument(
        "--rate", type=float, action="append", metavar="R", help=f"share of bad bytes ({RATE:g})"
    )
    parser.add_argument("--board", action="store_true", help="the firmware, on an emulated board")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        todo = simulated(range(options.seeds), options.rate or [RATE])
        if options.board:
            bugs = re.findall(r"^#ifndef (BUG_\w+)$", (FIRMWARE / "bugs.h").read_text(), re.M)
            todo = boards(options.seeds, partial(_built, Path(folder)), bugs)
        return _run(todo, options.level, options.jobs)


def _run(todo: list[Trial], level: str, jobs: int) -> int:
    count, wrong = Counter[tuple[str, int]](), 0
    with ProcessPoolExecutor(jobs) as pool:
        outcomes = pool.map(partial(noisy_run, level=level), todo)
        pairs = zip(todo, outcomes, strict=True)
        console = Console(stderr=True)
        for trial, (code, told) in track(pairs, "runs", len(todo), console=console):
            count["a faulty device" if trial.fault else "the reference", code] += 1
            if code not in trial.expected:
                wrong += 1
                name = trial.fault or "reference"
                _tell(f"{name} {trial.line} {trial.rate:g} seed {trial.seed}: exit {code}: {told}")
    for (what, code), times in sorted(count.items()):
        _tell(f"{what}: exit {code} in {times} runs")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
