"""Seeded runs of the suite over a bad line, in virtual time: which there are, and one run.

The devices are the simulator and faults of its bank, or the firmware and its planted bugs under
simavr, over a line that drops 1e-4, flips 1e-5 and holds each byte up for 5 ms. The harms `noise`
and `board` (`benchmarks.torture`) make them.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from benchmarks.commands import ROOT
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
    def told(self) -> str:
        """Its line in words."""
        return "the far firmware" if self.firmware else f"bytes {self.line} at {self.rate:g}"

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


def boards(seeds: Iterable[int], folder: Path) -> list[Trial]:
    """The clean firmware, once for each seed; as often firmware with a bug, each bug in its turn.

    They are built in a folder.
    """
    bugs = re.findall(r"^#ifndef (BUG_\w+)$", (FIRMWARE / "bugs.h").read_text(), re.M)
    return [
        Trial(bug, "far", seed, firmware=_built(folder, bug))
        for seed in seeds
        for bug in ("", bugs[seed % len(bugs)])
    ]


def _built(folder: Path, bug: str) -> Path:
    out = folder / (bug or "clean")
    if not out.exists():
        words = ["make", "-s", "-C", str(FIRMWARE), f"OUT={out}", f"BUGS={bug and '-D' + bug}"]
        words.append(f"BILPROV={sys.executable} -m bilprov")
        subprocess.run(words, check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
    return out / "uno.elf"
