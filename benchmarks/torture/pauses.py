"""Processes that are stopped for a while, as by a busy machine: SIGSTOP, and SIGCONT later.

The suite or the robot is stopped again and again while one judges the other; and `sniff --judge`
once, between an instruction and its answer, while traffic goes on.
"""

from __future__ import annotations

import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from random import Random

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import Hurt, Served, faulty, measure
from benchmarks.torture.unplugged_taps import Listener, Plug, Talk, heard
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.fields import Outcome

FAULTY = faulty("ok-to-unknown-id", "no-stop-on-bad-data", "every-7th-fault-missed")
_TIMES = ((0.05, 1.0), (0.3, 1.0), (0.04, 5.0))  # s that it is stopped, s from stop to stop
_PAUSE = 2.0  # s that sniff is stopped
_BEFORE_AND_AFTER = 1.0  # s of traffic
_IDLE = 0.3  # s of silence first: then it is clear where frames begin
_EXCHANGE = 0.02  # s from one instruction to the next
_ANSWER = 0.005  # s from an instruction to its answer
_WRONG = 0.1  # of the answers of a faulty device


@contextmanager
def stopped(process: subprocess.Popen[bytes], held: float, each: float) -> Iterator[None]:
    """Stop a process for `held` (s) once every `each` (s) until the end of the block."""
    over = threading.Event()

    def stop() -> None:
        while not over.wait(each - held):
            process.send_signal(signal.SIGSTOP)
            over.wait(held)
            process.send_signal(signal.SIGCONT)

    thread = threading.Thread(target=stop)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _pausing(held: float, each: float, *, robot: bool) -> Hurt:
    def beside(stack: ExitStack, there: Served, suite: subprocess.Popen[bytes]) -> None:
        stack.enter_context(stopped(there.process if robot else suite, held, each))

    return Hurt(beside=beside)


HURTS = {
    f"while {who} is stopped for {held * 1e3:.0f} ms every {each:g} s": _pausing(
        held, each, robot=who == "the robot"
    )
    for who in ("the suite", "the robot")
    for held, each in _TIMES
}


def sniffed(seed: int, *, good: bool) -> str:
    """Stop `sniff --judge` in traffic of a good or a faulty device: what is wrong, "" if nothing.

    A faulty device refuses now and then what is right.
    """
    draw, talk = Random(f"{seed} {good}"), Talk(Random(seed))
    refused = load_protocol().answers[Outcome.BAD_DATA].code
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host, device = Plug(folder / "host"), Plug(folder / "device")
        stack.callback(host.pull)
        stack.callback(device.pull)
        sniff = Listener(stack, folder, str(host.path), str(device.path), "--judge")

        def asked() -> bytes:
            frame, answer = talk.next()
            if not good and draw.random() < _WRONG:
                answer = bytes([refused])
            host.write(frame)
            talk.wrote("host", frame)
            time.sleep(_ANSWER)
            return answer

        def answered(answer: bytes) -> None:
            device.write(answer)
            talk.wrote("device", answer)
            time.sleep(_EXCHANGE - _ANSWER)

        def traffic(seconds: float) -> None:
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                answered(asked())

        time.sleep(_IDLE)
        traffic(_BEFORE_AND_AFTER)
        answer = asked()
        sniff.process.send_signal(signal.SIGSTOP)
        answered(answer)
        traffic(_PAUSE)
        sniff.process.send_signal(signal.SIGCONT)
        traffic(_BEFORE_AND_AFTER)
        code = sniff.end()
        if heard(sniff.capture) != talk.written:
            return f"seed {seed}: the capture has not just what was said"
        told = f"seed {seed}: exit {code}: {sniff.told.strip()[-300:]}"
        return "" if code == (0 if good else 1) else told


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    rows = measure(HURTS, FAULTY, runs, seed, progress)
    seeds = range(seed, seed + max(1, runs // 4))
    return [*rows, _sniff_row(seeds, good=True), _sniff_row(seeds, good=False)]


def _sniff_row(seeds: range, *, good: bool) -> Row:
    with ThreadPoolExecutor(2) as pool:
        wrong = tuple(filter(None, pool.map(partial(sniffed, good=good), seeds)))
    device = f"a {'good' if good else 'faulty'} device"
    return Row(
        f"`sniff --judge` of {device} stopped for {_PAUSE:g} s before an answer",
        len(seeds),
        f"{len(wrong)} judged wrongly or not whole",
        wrong,
    )


HARM = Harm("pauses", "processes that are stopped for a while", 4 * len(HURTS), _measure)
