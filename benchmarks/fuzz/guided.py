"""`python -m benchmarks.fuzz.guided TARGET [-runs=N] [-seed=S]`: fuzzing guided by coverage.

It needs atheris (`pip install atheris`), which measures which branches an input takes; inputs that
take new ones are kept in build/fuzz/corpus and damaged further. The options are libFuzzer's. It
ends at the first input that the target fails on, and names the file that holds it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from random import Random

import atheris

KEPT = Path(__file__).resolve().parent.parent.parent / "build" / "fuzz" / "corpus"


def main() -> None:
    """Fuzz the target that the first argument names, until it fails or all inputs are done."""
    with atheris.instrument_imports(include=["bilprov"]):
        from benchmarks.fuzz.engine import Failed, outcome_of, watched
        from benchmarks.fuzz.targets import TARGETS

    name, *arguments = sys.argv[1:] or [""]
    if name not in TARGETS:
        sys.exit(f"say which of {', '.join(TARGETS)}")
    target = TARGETS[name]
    test, pool = target.prepare(), target.pool()
    folder = KEPT / name
    folder.mkdir(parents=True, exist_ok=True)

    def one(data: bytes) -> None:
        outcome = outcome_of(target, test, data)
        if isinstance(outcome, Failed):
            raise RuntimeError(outcome.said)

    def mutated(data: bytes, most: int, seed: int) -> bytes:
        random = Random(seed)
        base = [data] if data and random.random() < 0.8 else pool
        return target.mutate(random, base)[:most]

    words = [sys.argv[0], "-rss_limit_mb=0", "-max_len=65536", *arguments, str(folder)]
    with watched():
        atheris.Setup(words, one, custom_mutator=mutated)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
