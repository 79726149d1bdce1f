"""No false alarm on a busy machine: the suite over TCP in real time, CPU burners beside it.

`python -m benchmarks.load [--runs N] [--burners N] [--at-once N]`: each run drives a simulator of
its own with the tcp probe at level standard. Prints what each run ended in and what was worse than
informational; ends with 1 if a run did not end in 0.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

_WORSE = ("non-strict", "inconclusive", "fail", "error")


def _burn() -> None:
    with suppress(KeyboardInterrupt):
        while True:
            pass


def loaded_run(number: int, level: str) -> tuple[int, list[str]]:
    """One run against a served simulator: its exit code, and what was worse than informational."""
    serve = [sys.executable, "-m", "bilprov", "simulate"]
    serve += ["--listen", "127.0.0.1:0", "--probe-listen", "127.0.0.1:0"]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as served:
        try:
            assert served.stdout is not None
            port = served.stdout.readline().strip()
            probe = served.stdout.readline().strip().removeprefix("probe ")
            run = [sys.executable, "-m", "bilprov", "conform", port, "--probe", probe, "--yes"]
            run += ["--level", level, "--seed", str(number), "--json", "-"]
            done = subprocess.run(run, capture_output=True, text=True, check=False)
        finally:
            served.terminate()
    if not done.stdout:
        return done.returncode, done.stderr.splitlines()[-1:]
    told = []
    for case in json.loads(done.stdout)["cases"]:
        if case["verdict"] in _WORSE:
            reasons = [axis["reason"] for axis in case["axes"].values() if axis["reason"]]
            told.append(f"{case['verdict']} {case['id']}: {'; '.join(reasons)}")
    return done.returncode, told


def _tell(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run them all; returns 1 if one did not end in 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=10, metavar="N", help="runs (10)")
    parser.add_argument("--burners", type=int, default=6, metavar="N", help="busy processes (6)")
    parser.add_argument("--at-once", type=int, default=2, metavar="N", help="runs at a time (2)")
    parser.add_argument("--level", default="standard", help="the suite's level (standard)")
    options = parser.parse_args()
    burners = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(options.burners)]
    wrong = 0
    try:
        for burner in burners:
            burner.start()
        with ThreadPoolExecutor(options.at_once) as pool:
            numbers = range(1, options.runs + 1)
            runs = pool.map(partial(loaded_run, level=options.level), numbers)
            for number, (code, told) in zip(numbers, runs, strict=True):
                wrong += code != 0
                _tell("\n  ".join([f"run {number}: exit {code}", *told[:8]]))
    finally:
        for burner in burners:
            burner.terminate()
    _tell(f"{options.runs - wrong} of {options.runs} runs ended in 0")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
