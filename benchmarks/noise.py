"""Runs of the suite over a noisy line: no false fail of the reference, no wrong pass of a fault.

`python -m benchmarks.noise [--seeds N] [--jobs N] [--only NAME]`: seeded runs at level standard in
virtual time, with one bad byte in ten thousand. Prints a line per run that went otherwise than it
may, then a table; ends with 1 if there was one.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from analyzer.grammar_file import load_protocol
from conformance.api import Options, conform
from conformance.faults import fault_bank
from conformance.noise import Noise, NoisyDevice
from conformance.simulator import Simulator
from conformance.verdicts import Verdict

RATE = 1e-4
LINES = {
    "flipped": Noise(flipped=RATE),
    "dropped": Noise(dropped=RATE),
    "doubled": Noise(doubled=RATE),
    "mixed": Noise(RATE / 3, RATE / 3, RATE / 3),
}
FAULTS = 12  # of the bank, evenly spread


def noisy_run(task: tuple[str, str, int], level: str = "standard") -> tuple[int, str]:
    """Run one device over one noisy line: the exit code, and what failed or ended the run.

    `task` is the device's fault ("" for the reference), the line's name and the seed.
    """
    fault, line, seed = task
    protocol = load_protocol()
    device = Simulator(protocol, fault_bank(protocol)[fault] if fault else None)
    try:
        report = conform(
            NoisyDevice(device, LINES[line], seed),
            grammar=protocol,
            options=Options(level=level, seed=seed),
        )
    except Exception as error:  # a kit that breaks is what is looked for
        return 2, f"{type(error).__name__}: {error}"
    bad = [r for r in report.results if r.verdict is Verdict.FAIL]
    told = [f"{r.id}: {next(a.reason for a in r.axes.values() if a.reason)}" for r in bad[:4]]
    return report.exit, "; ".join(told) or report.unusable or report.ended_by


def tasks(seeds: int) -> list[tuple[str, str, int]]:
    """The reference over each line, `seeds` times in all; as often the faulty devices."""
    bank = [fault.name for fault in fault_bank(load_protocol()).values() if not fault.needs]
    faults = bank[:: len(bank) // FAULTS][:FAULTS]
    lines = list(LINES)
    return [
        *(("", lines[seed % len(lines)], seed) for seed in range(seeds)),
        *((faults[seed % FAULTS], lines[seed % len(lines)], seed) for seed in range(seeds)),
    ]


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run them all; returns 1 if one went otherwise than it may."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=50, metavar="N", help="runs of each kind (50)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    parser.add_argument("--level", default="standard", help="the suite's level (standard)")
    options = parser.parse_args()
    todo, count, wrong = tasks(options.seeds), Counter[tuple[str, int]](), 0
    with ProcessPoolExecutor(options.jobs) as pool:
        run = partial(noisy_run, level=options.level)
        for task, (code, told) in zip(todo, pool.map(run, todo), strict=True):
            fault, line, seed = task
            count["a faulty device" if fault else "the reference", code] += 1
            if code not in ((1, 3) if fault else (0, 3)):
                wrong += 1
                _tell(f"{fault or 'reference'} {line} seed {seed}: exit {code}: {told}")
    for (what, code), times in sorted(count.items()):
        _tell(f"{what}: exit {code} in {times} runs")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
