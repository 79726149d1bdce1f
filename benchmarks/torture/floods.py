"""Devices that send without end, or stop reading: how much memory each command needs at most.

Each command runs in a process of its own, with a device on a pty that this process plays: it sends
answers without end from the start, or from a moment on that the seed draws, or takes and says
nothing more from such a moment on. Wrong is more than 150 MB at the peak, a traceback, and a
command that does not end within its own bounds.
"""

from __future__ import annotations

import select
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from random import Random
from typing import NamedTuple

from benchmarks.commands import Ended, bilprov_words, run_any
from benchmarks.torture.exits import items, replay_to
from benchmarks.torture.harm import Harm, Row, tracked
from bilprov.analyzer.client.rest import stops
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.port import PtyPair, open_pty
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.fields import Outcome

_PATIENCE = 150.0  # s: a run of the suite that is slow ends itself in about 70
_MEMORY = 150_000_000  # bytes
_LISTENED = 3  # s for which a tap hears a flood
_STEP = 0.001  # s

Peer = Callable[[PtyPair, int, threading.Event], None]
"""Plays a device on a pty, good for so many bytes of the host, until the event."""


def _good(pair: PtyPair, count: int, over: threading.Event) -> None:
    """Answer as the reference until so many bytes have come."""
    robot, heard = Simulator(load_protocol()), 0
    while heard < count and not over.is_set():
        data = pair.read()
        heard += len(data)
        now = time.monotonic_ns()
        robot.receive(data, now)
        pair.write_some(robot.advance(now))
        time.sleep(_STEP)


def _endless(pair: PtyPair, count: int, over: threading.Event) -> None:
    """Answer without end from then on."""
    _good(pair, count, over)
    protocol = load_protocol()
    flood = bytes([protocol.answers[Outcome.VALID].code]) * 4096
    while not over.is_set():
        ready, room, _ = select.select([pair.master], [pair.master], [], 0.05)
        if ready:
            pair.read()
        if room:
            pair.write_some(flood)


def _stalled(pair: PtyPair, count: int, over: threading.Event) -> None:
    """Neither take nor say anything from then on."""
    _good(pair, count, over)
    over.wait()


class Goes(NamedTuple):
    """How a device goes wrong: what plays it, and whether it is good for a while before."""

    peer: Peer
    later: bool


PEERS = {
    "that answers without end": Goes(_endless, later=False),
    "that answers without end after a while": Goes(_endless, later=True),
    "that takes nothing after a while": Goes(_stalled, later=True),
}


@contextmanager
def _played(peer: Peer, count: int) -> Iterator[str]:
    """The path of a port with that device."""
    over = threading.Event()
    with open_pty() as pair:
        thread = threading.Thread(target=peer, args=(pair, count, over))
        thread.start()
        try:
            yield pair.name
        finally:
            over.set()
            thread.join()


class Command(NamedTuple):
    """A command: its words for a port and a folder, how many bytes it sends, what is typed.

    A command that sends nothing listens only.
    """

    words: Callable[[str, Path], list[str]]
    bytes: int = 0
    typed: str = ""


def _plain(name: str, count: int, *more: str, typed: str = "") -> Command:
    return Command(
        lambda port, folder: bilprov_words(*name.split(), port, "--yes", *more), count, typed
    )


def _listens(*more: str) -> Command:
    """`sniff` at a flood."""

    def words(port: str, folder: Path) -> list[str]:
        out = str(folder / "run.mcap")
        return bilprov_words("sniff", *more, port, "-w", out, "--duration", str(_LISTENED))

    return Command(words)


COMMANDS = {
    "conform": _plain("conform", 4000, "--level", "smoke"),
    "lab learn": _plain("lab learn", 4000),
    "send": _plain("send", 25, *items(pause="pause=300")),
    # More bytes at once than a pty holds.
    "send --together": _plain("send", 60_000, "--together", *["00" * 30_000] * 3),
    "send, typed": _plain("send", 25, typed="\n".join(items(pause="pause=300")) + "\n"),
    "replay --to": Command(replay_to, 150),
    "sniff": _listens(),
    "sniff --bridge": _listens("--bridge"),
}
"""Every command that listens to a port."""

PAIRS = tuple(
    (name, peer)
    for name, peer in product(COMMANDS, PEERS)
    if COMMANDS[name].bytes or not PEERS[peer].later
)
"""Each command with each device; a device goes wrong later only by what is sent to it."""


def flooded(name: str, peer: str, seed: int) -> Ended | str:
    """Run a command at that device; how it ended, or in words that it did not."""
    command = COMMANDS[name]
    played, later = PEERS[peer]
    draw = Random(f"{seed} {name} {peer}")
    count = len(stops(load_protocol())) + draw.randint(1, command.bytes) if later else 0
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryFile() as typed,
        _played(played, count) as port,
    ):
        typed.write(command.typed.encode())
        typed.seek(0)
        try:
            words = command.words(port, Path(folder))
            return run_any(words, patience=_PATIENCE, stdin=typed)
        except TimeoutError as late:
            return str(late)


def _measure(runs: int, seed: int) -> list[Row]:
    """Run every command at every device so often; a row for each pair."""
    came = defaultdict[tuple[str, str], list[Ended | str]](list)
    for turn in tracked(range(seed, seed + runs), runs):
        for name, peer in PAIRS:
            came[name, peer].append(flooded(name, peer, turn))
    return [_row(name, peer, ended) for (name, peer), ended in came.items()]


def _row(name: str, peer: str, came: list[Ended | str]) -> Row:
    ended = [one for one in came if isinstance(one, Ended)]
    codes = ", ".join(sorted({str(one.code) for one in ended}))
    memory = max((one.memory for one in ended), default=0)
    seconds = max((one.seconds for one in ended), default=0.0)
    return Row(
        f"`{name}` at a device {peer}",
        len(came),
        f"{memory / 1e6:.0f} MB at the peak; ended within {seconds:.0f} s, exit {codes or 'none'}",
        tuple(filter(None, map(wrong_with, came))),
    )


def wrong_with(one: Ended | str) -> str:
    """What is wrong with how a command ended, "" for nothing."""
    if isinstance(one, str):
        return one
    last = one.error.strip()[-300:]
    if one.memory > _MEMORY:
        return f"{one.memory / 1e6:.0f} MB, allowed are {_MEMORY / 1e6:.0f} MB: {last}"
    if "Traceback" in one.error:
        return f"a traceback: {last}"
    if one.code not in range(4):
        return f"exit {one.code}: {last}"
    return f"exit {one.code} without a sentence" if one.code == 2 and not last else ""


HARM = Harm("floods", "devices that send without end or take nothing, and memory", 2, _measure)
