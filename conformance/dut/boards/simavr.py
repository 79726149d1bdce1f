"""An Arduino Uno emulated by simavr: in process, in virtual time, the same every time."""

from __future__ import annotations

from pathlib import Path

from bilprov.captures.schemas import Look
from bilprov.conformance.dut.boards import uno
from bilprov.conformance.dut.boards.firmware import read_firmware
from bilprov.conformance.dut.boards.libsimavr import Avr

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
        self._code, self._start = read_firmware(firmware, uno.FLASH, start)
        if self._start and self._code.startswith(_ERASED):
            self._code = _WAIT + self._code[len(_WAIT) :]
        self._avr: Avr | None = None
        self.power_cycle(0)

    def power_cycle(self, now: int) -> None:
        """Switch the board off and on at `now`."""
        self.close()
        self._sent = bytearray()
        self._avr = Avr(self._code, uno.CHIP, uno.FREQUENCY, self._sent.append, self._start)
        self._now = self._lively = now
        self._begun = now - _BOOT

    def reset(self, now: int) -> None:
        """Pull its reset pin at `now`, or rather as long before as it takes to boot.

        The flash stays as it is; a time not yet run is left out.
        """
        self._powered.reset()
        self._sent.clear()
        self._now = self._lively = now
        self._begun = now - _BOOT - self._powered.cycle * _NS // uno.FREQUENCY

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
        return uno.look(self.memory, now)

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
        return uno.unread(self._powered.memory)

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
        self._powered.run_until((now - self._begun) * uno.FREQUENCY // _NS)
