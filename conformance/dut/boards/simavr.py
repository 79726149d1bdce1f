"""An Arduino Uno emulated by simavr: in process, in virtual time, the same every time.

And the same in real time, for a pty: bytes take their time on the wire, both ways. After a late
call such a board catches up and skips nothing. The wiring of the reference robot is the firmware's
(see firmware/README.md).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.dut.boards.firmware import read_firmware
from bilprov.conformance.dut.boards.libsimavr import Avr

CHIP, FREQUENCY, FLASH = "atmega328p", 16_000_000, 1 << 15  # Hz, bytes

# Registers in the data space of an ATmega328P.
_PORTS = {"B": 0x25, "C": 0x28, "D": 0x2B}
_TCCR0A, _TCCR0B = 0x44, 0x45
_UCSR0A, _RXC0 = 0xC0, 0x80
_LIGHT = 0b111  # A2 to A0


@dataclass(frozen=True, slots=True)
class _Motor:
    """A motor driver: its pins as (port, bit), its duty register, the bit that enables its PWM."""

    forward: tuple[str, int]
    backward: tuple[str, int]
    pwm: tuple[str, int]
    duty: int
    connected: int

    def speed(self, memory: Callable[[int], int]) -> int:
        """The speed, -255 to 255, forward positive; 0 if it is off, brakes or has no duty."""
        forward, backward = (_is_high(memory, *pin) for pin in (self.forward, self.backward))
        if forward == backward or not _is_output(memory, *self.pwm):
            return 0
        if not memory(_TCCR0A) & self.connected:
            duty = 255 * _is_high(memory, *self.pwm)  # a plain pin
        else:
            duty = memory(self.duty) if memory(_TCCR0B) & 0b111 else 0
        return duty if forward else -duty


_LEFT = _Motor(("D", 7), ("B", 0), ("D", 6), duty=0x47, connected=0x80)
_RIGHT = _Motor(("B", 1), ("B", 2), ("D", 5), duty=0x48, connected=0x20)


def _motion(left: int, right: int) -> str:
    if left * right < 0:
        return "rotate_right" if left > 0 else "rotate_left"
    if left or right:
        return "forward" if left + right > 0 else "backward"
    return "stopped"


def _is_high(memory: Callable[[int], int], port: str, bit: int) -> bool:
    """Whether the pin is driven high; a pin that is no output drives nothing."""
    return bool(_is_output(memory, port, bit) and memory(_PORTS[port]) >> bit & 1)


def _is_output(memory: Callable[[int], int], port: str, bit: int) -> bool:
    return bool(memory(_PORTS[port] - 1) >> bit & 1)


_NS = 1_000_000_000
_BUSY, _IDLE = 20_000, 500_000  # ns between two checks for bytes it sends
_SOON = 3_000_000  # ns after a byte in which it may answer
_BOOT = 20_000_000  # ns from power-on to the first use of the line
_ERASED = b"\xff\xff"  # flash without a program, which the emulator cannot run
_WAIT = b"\xff\xcf"  # an instruction that jumps to itself


class SimavrBoard:
    """A board with its firmware as a device under test: times are integers in nanoseconds.

    The firmware starts at the address `start`, by default where its file tells. If that is in a
    boot section and there is no program below it, the chip waits where that would be.

    Raises EmulatorError, in one sentence, where simavr is missing or cannot load the file.
    """

    lossless = True

    def __init__(self, firmware: Path, start: int | None = None) -> None:
        # The emulator's own reader of ELF files crashes on damaged ones.
        self._code, self._start = read_firmware(firmware, FLASH, start)
        if self._start and self._code.startswith(_ERASED):
            self._code = _WAIT + self._code[len(_WAIT) :]
        self._avr: Avr | None = None
        self.power_cycle(0)

    def power_cycle(self, now: int) -> None:
        """Switch the board off and on at `now`."""
        self.close()
        self._sent = bytearray()
        self._avr = Avr(self._code, CHIP, FREQUENCY, self._sent.append, self._start)
        self._now = self._lively = now
        self._begun = now - _BOOT

    def reset(self, now: int) -> None:
        """Pull its reset pin at `now`, or rather as long before as it takes to boot.

        The flash stays as it is; a time not yet run is left out.
        """
        self._powered.reset()
        self._sent.clear()
        self._now = self._lively = now
        self._begun = now - _BOOT - self._powered.cycle * _NS // FREQUENCY

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._run(now)
        for byte in data:
            self._powered.receive(byte)
        self._lively = now

    def spoil(self, byte: int, now: int) -> None:
        """A byte from the host that arrives at `now` with a framing error."""
        self._run(now)
        self._powered.receive(byte, spoilt=True)

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`; return the bytes the board has sent until then."""
        self._run(now)
        sent = bytes(self._sent)
        if sent:
            self._sent.clear()
            self._lively = now
        return sent

    def deadline(self) -> int:
        """When to call `advance` next: firmware may act at any time."""
        return self._now + (_BUSY if self._now < self._lively + _SOON else _IDLE)

    def look(self, now: int) -> Look:
        """What the pins and the PWM registers say at `now`."""
        self._run(now)
        left, right = _LEFT.speed(self.memory), _RIGHT.speed(self.memory)
        lit = self.memory(_PORTS["C"]) & self.memory(_PORTS["C"] - 1) & _LIGHT
        return CarLook(
            now, bool(left or right), _motion(left, right), led=lit, left=left, right=right
        )

    def memory(self, address: int) -> int:
        """The byte at an address of the chip's data space: a register, or RAM."""
        return self._powered.memory(address)

    @property
    def crashed(self) -> bool:
        """Whether the firmware has crashed: it sleeps for ever, or it runs no valid code."""
        return self._powered.crashed

    @property
    def unread(self) -> bool:
        """Whether a byte has arrived that the firmware has not read."""
        return bool(self.memory(_UCSR0A) & _RXC0)

    def close(self) -> None:
        """End the emulator."""
        if self._avr:
            self._avr.close()
            self._avr = None

    @property
    def _powered(self) -> Avr:
        assert self._avr is not None, "the board was closed"
        return self._avr

    def _run(self, now: int) -> None:
        self._now = max(self._now, now)
        self._powered.run_until((now - self._begun) * FREQUENCY // _NS)


HELD = 1 << 20
"""Most bytes that wait for the wire, more than a minute's worth; further ones are lost."""

_NEAR = 100_000  # ns; a board whose deadline is nearer is busy
_REST = 2_000_000  # ns between two calls for a board that is not busy
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
            busy = self._chunks or self._board.deadline() - self._at < _NEAR
            wanted.append(self._at + (self._byte_time if busy else _REST))
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
                self.crashed = True
                self._discard()
                self._note(
                    f"the firmware crashed {self._at / 1e9:.3f} s after its start: its pins stay "
                    "as they are and nothing is answered until the port is opened again, which "
                    "resets it"
                )

    def _discard(self) -> None:
        self._chunks.clear()
        self._held = self._index = 0
