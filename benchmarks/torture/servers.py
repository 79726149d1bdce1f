"""How late a look at the simulator's probe is under 200 slow clients, and beside a flood.

p50 and p99 in ms with nobody else there, with 200 clients that send their requests byte by byte,
and with one that floods newlines. Wrong is only a look that fails or takes 30 s, or a client or a
simulator that is cut off: how many ms a look takes is the machine's.
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle
from statistics import quantiles

from benchmarks.torture.harm import Harm, Progress, Row
from benchmarks.torture.robots import served
from bilprov.analyzer.transport.streams import parse_address

_PATIENCE = 30.0  # s; a look that takes longer has failed
_SLOW = 200  # clients
_STEP = 0.001  # s between two looks, and between two bytes of a slow client
_FLOOD = b"\n" * (1 << 16)

Address = tuple[str, int]


def _connected(address: Address) -> socket.socket:
    return socket.create_connection(address, timeout=_PATIENCE)


def _slow(address: Address) -> None:
    """Send requests byte by byte from 200 clients, and read what is answered."""
    with ExitStack() as stack:
        clients = [stack.enter_context(_connected(address)) for _ in range(_SLOW)]
        for client in clients:
            client.setblocking(False)
        for byte in cycle(b"state\n"):
            for client in clients:
                client.send(bytes([byte]))
                with suppress(BlockingIOError):
                    if not client.recv(1 << 16):
                        return
            time.sleep(_STEP)


def _flood(address: Address) -> None:
    """Send newlines without a pause and without reading; connect anew when closed for that."""
    while True:
        with suppress(ConnectionError, TimeoutError), _connected(address) as client:
            while True:
                client.sendall(_FLOOD)


_HARMS: dict[str, Callable[[Address], None]] = {
    "nobody else": lambda _: time.sleep(3600),
    f"{_SLOW} slow clients": _slow,
    "a flood of newlines": _flood,
}


@contextmanager
def _beside(work: Callable[[Address], None], address: Address) -> Iterator[None]:
    """Let another process do `work` meanwhile. Raises ValueError if it ends by itself."""
    process = multiprocessing.Process(target=work, args=(address,), daemon=True)
    process.start()
    try:
        yield
        if not process.is_alive():
            raise ValueError("the other clients were cut off")
    finally:
        process.terminate()
        process.join()


def _looks(probe: socket.socket, count: int) -> list[float]:
    """Look so often; the times in ms. Raises OSError or ValueError where a look fails."""
    took = []
    with probe.makefile("rb") as answers:
        for _ in range(count):
            begin = time.perf_counter()
            probe.sendall(b"state\n")
            if "moving" not in json.loads(answers.readline()):
                raise ValueError("the answer does not say whether it moves")
            took.append((time.perf_counter() - begin) * 1e3)
            time.sleep(_STEP)
    return took


def _measure(runs: int, seed: int, progress: Progress) -> list[Row]:
    """Look so often beside each harm; nothing is drawn here, so the seed does nothing."""
    rows = []
    with served() as (simulator, _, own_probe):
        address = parse_address(own_probe.name.removeprefix("tcp:"))
        count = max(2, runs // len(_HARMS))
        for name, work in _HARMS.items():
            told, wrong = "", []
            try:
                with _connected(address) as probe, _beside(work, address):
                    _looks(probe, 100)  # until the others are there
                    percent = quantiles(_looks(probe, count), n=100)
                told = f"p50 {percent[49]:.2f} ms, p99 {percent[98]:.2f} ms"
            except (OSError, ValueError) as error:
                wrong = [f"a look failed: {error}"]
            if simulator.poll() is not None:
                wrong.append(f"the simulator ended with {simulator.returncode}")
            rows.append(
                Row(f"looks at the probe of `simulate` beside {name}", count, told, tuple(wrong))
            )
            progress(count)
    return rows


HARM = Harm("servers", "looks at a probe beside slow and flooding clients", 3000, _measure)
