"""Runs an emulated board in real time, for a pty: bytes take their time on the wire, both ways.

The caller passes the time; no port here. After a late call the board catches up and skips nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec

from bilprov.conformance.dut.boards.simavr import SimavrBoard

HELD = 1 << 20
"""Most bytes that wait for the wire, more than a minute's worth; further ones are lost."""

_SOON = 100_000  # ns; a board whose deadline is nearer is busy
_IDLE = 2_000_000  # ns between two calls for a board that is not busy
_SLICE = 20_000_000  # ns caught up at a time, so that Ctrl-C and probes are served meanwhile
_SEEN = 1_000_000_000  # ns caught up for a probe at most
_AGAIN = 20_000  # ns until the next check whether the chip has read a byte
_WAITED = 3  # bytes' time, after which the line no longer waits for the chip to read


class PacedBoard:
    """A simavr board as a device to serve: times are integers in ns since its power-on.

    `byte_time` is the time of a byte on the wire in ns. The emulator takes a bit longer for one and
    silently drops bytes that do not fit its small buffer: so a byte waits until the one before is
    read. `note` is called with one sentence if the firmware crashed or bytes were lost.
    """

    def __init__(self, board: SimavrBoard, byte_time: int, note: Callable[[str], None]) -> None:
        self.crashed = False
        self._board = board
        self._byte_time = byte_time
        self._note = note
        self._at = 0  # the time up to which the board has run
        self._chunks: deque[tuple[int, bytes]] = deque()  # (arrival, bytes of the host)
        self._index = 0  # number of bytes of the first chunk already handed over
        self._held = 0
        self._flooded = False
        # When the wire to the chip is free, and when it takes a byte although one is unread.
        self._free = self._run_over = 0
        self._back = 0  # when the wire to the host is free
        self._answers: deque[tuple[int, int]] = deque()  # (arrival, answer)

    def receive(self, data: bytes, now: int) -> None:
        """Take bytes from the host: the first one's start bit is at `now`, if the wire is free."""
        fitting = data[: HELD - self._held]
        if len(fitting) < len(data) and not self._flooded:
            self._flooded = True
            self._note(f"{HELD} bytes wait for the wire already: what the host sends more is lost")
        if fitting and not self.crashed:
            self._chunks.append((now, fitting))
            self._held += len(fitting)

    def reset(self, now: int) -> None:
        """Reset the microcontroller at `now`; bytes that are on their way are lost."""
        self._board.reset(now)
        self.crashed = False
        self._at = self._free = self._run_over = self._back = now
        self._discard()
        self._answers.clear()

    def advance(self, now: int) -> bytes:
        """Run the board until `now`, or a part of the way; return the answers that arrived."""
        self._catch_up(min(now, self._at + _SLICE))
        due = bytearray()
        while self._answers and self._answers[0][0] <= now:
            due.append(self._answers.popleft()[1])
        return bytes(due)

    def deadline(self) -> int | None:
        """Return when (ns) `advance` is to be called next; None if the board crashed."""
        wanted = [self._answers[0][0]] if self._answers else []
        if not self.crashed:
            # An answer is under way for a byte's time: calls at that interval deliver it in time.
            busy = self._chunks or self._board.deadline() - self._at < _SOON
            wanted.append(self._at + (self._byte_time if busy else _IDLE))
        return min(wanted, default=None)

    def probe(self, now: int) -> bytes:
        """Return what the pins show as one line of JSON without newline.

        A board that is behind first runs until `now`, or for `_SEEN`: a host that has waited for a
        stop would otherwise see the robot as it was before.
        """
        self._catch_up(min(now, self._at + _SEEN))
        look = msgspec.to_builtins(self._board.look(self._at))
        del look["t"]
        return msgspec.json.encode({name: seen for name, seen in look.items() if seen is not None})

    def _catch_up(self, until: int) -> None:
        """Run the board until `until` (ns), and hand over the bytes that are due by then."""
        until = max(self._at, until)
        while (start := self._next()) is not None and start <= until:
            self._run(start)
            if not self.crashed:  # on the way there
                self._begin(start)
        self._run(until)

    def _next(self) -> int | None:
        """When (ns) the next byte of the host can start, None where none waits."""
        return max(self._chunks[0][0], self._free) if self._chunks else None

    def _begin(self, start: int) -> None:
        """Hand over the next byte to the board, unless the one before has not been read.

        This happens at its start bit: the emulator adds the time of the byte itself.
        """
        if self._board.unread and start < self._run_over:
            self._free = start + _AGAIN
            return
        data = self._chunks[0][1]
        self._board.receive(data[self._index : self._index + 1], start)
        self._free = start + self._byte_time
        self._run_over = self._free + _WAITED * self._byte_time
        self._held -= 1
        self._index += 1
        if self._index == len(data):
            self._chunks.popleft()
            self._index = 0

    def _run(self, until: int) -> None:
        """Run the board until `until` (ns), in steps as small as its deadlines ask for."""
        while not self.crashed and self._at < until:
            self._at = min(until, max(self._board.deadline(), self._at + 1))
            for answer in self._board.advance(self._at):
                self._back = max(self._back, self._at) + self._byte_time
                self._answers.append((self._back, answer))
            if self._board.crashed:
                self._give_up()

    def _give_up(self) -> None:
        self.crashed = True
        self._discard()
        self._note(
            f"the firmware crashed {self._at / 1e9:.3f} s after its start: its pins stay as they "
            "are and nothing is answered until the port is opened again, which resets it"
        )

    def _discard(self) -> None:
        self._chunks.clear()
        self._held = self._index = 0
