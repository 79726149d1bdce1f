"""The wiring of the reference robot on an Arduino Uno, and the Look that its pins show.

The wiring is the firmware's (see firmware/README.md); nothing here knows the protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook

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


def look(memory: Callable[[int], int], now: int) -> Look:
    """What wheels and LED do, read from the pins and the PWM registers; `now` in ns."""
    left, right = _LEFT.speed(memory), _RIGHT.speed(memory)
    return CarLook(
        t=now,
        moving=bool(left or right),
        motion=_motion(left, right),
        led=memory(_PORTS["C"]) & memory(_PORTS["C"] - 1) & _LIGHT,
        left=left,
        right=right,
    )


def unread(memory: Callable[[int], int]) -> bool:
    """Whether the serial receiver holds a byte that the firmware has not read."""
    return bool(memory(_UCSR0A) & _RXC0)


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
