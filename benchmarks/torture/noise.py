"""The suite over lines that drop, flip and double bytes: no good robot fails, no faulty one passes.

A run is one seed: the simulator, and one with a fault of its bank, each over the same kind of line,
at level standard in virtual time.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product

from benchmarks.noisy_device import NoisyDevice
from benchmarks.torture.harm import Harm, Row, tracked
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.relay import Noise
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Device
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict

RATES = (1e-3, 3e-4, 1e-4)
"""Shares of bad bytes."""
LINES: dict[str, Callable[[float], Noise]] = {
    "flipped": lambda rate: Noise(flipped=rate),
    "dropped": lambda rate: Noise(dropped=rate),
    "doubled": lambda rate: Noise(doubled=rate),
    "mixed": lambda rate: Noise(rate / 3, rate / 3, rate / 3),
}
"""Kinds of line by the share of their bytes that are hurt."""
FAULTS = 12  # of the bank, evenly spread


@dataclass(frozen=True, slots=True)
class Trial:
    """One run to make: what is wrong with the device ("" for nothing), its line, the seed."""

    fault: str
    line: str
    seed: int
    rate: float = RATES[-1]

    def device(self) -> Device:
        """The device behind its line."""
        protocol = load_protocol()
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


def _measure(runs: int, seed: int) -> list[Row]:
    """Run the reference over a line, and a faulty device: each seed has another kind and rate."""
    bank = [fault.name for fault in fault_bank(load_protocol()).values() if not fault.needs]
    faults = bank[:: len(bank) // FAULTS][:FAULTS]
    pairs = list(product(RATES, LINES))
    trials = []
    for number in range(runs):
        rounds, place = divmod(number, len(pairs))
        rate, line = pairs[place]
        fault = faults[(place + rounds) % FAULTS]  # another one for this line in each round
        trials += [Trial(what, line, seed + number, rate) for what in ("", fault)]
    rows = defaultdict[str, list[tuple[Trial, int, str]]](list)
    with ProcessPoolExecutor(2) as pool:
        done = zip(trials, pool.map(noisy_run, trials), strict=True)
        for trial, ended in tracked(done, len(trials)):
            rows[f"bytes {trial.line} at {trial.rate:g}"].append((trial, *ended))
    return [_row(line, ended) for line, ended in rows.items()]


def _row(line: str, ended: list[tuple[Trial, int, str]]) -> Row:
    codes = Counter((trial.fault != "", code) for trial, code, _ in ended)
    shown = ", ".join(
        f"{'faulty' if faulty else 'good'}: exit {code} in {times}"
        for (faulty, code), times in sorted(codes.items())
    )
    return Row(
        f"the suite with {line}",
        len(ended),
        f"{codes[False, 1]} good robots failed, {codes[True, 0]} faulty ones passed ({shown})",
        tuple(
            f"{trial.fault or 'the reference'}, seed {trial.seed}: exit {code}: {reason}"
            for trial, code, reason in ended
            if code not in ((1, 3) if trial.fault else (0, 3))
        ),
    )


HARM = Harm("noise", "the suite over lines that hurt bytes", 200, _measure)
