"""Binding of libsimavr through ctypes: only the functions that a board needs, only in this file.

Written for libsimavr 1.6, as in Debian; another layout of its structures is refused.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import (
    CFUNCTYPE,
    POINTER,
    Structure,
    byref,
    c_char_p,
    c_int,
    c_int8,
    c_uint8,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
)

from bilprov.conformance.dut.boards import EmulatorError

INSTALL = "apt-get install simavr"
_LIBRARY = "libsimavr.so.2"
_INPUT, _OUTPUT = 0, 1  # of the serial line's IRQs
_FRAMING_ERROR = 0x8000
_BY_PIN, _BY_WATCHDOG = 1, 3  # places of the flags that tell why the chip was reset
_WATCHDOG_CONTROL, _CHANGES = 0x60, 0x10  # the register WDTCSR, and its bit WDCE
_EVERY_BIT = 8  # of the IRQs of a register
_STUCK = 10_000  # calls in which no cycle passes: it has crashed, or sleeps for ever
_QUIET = CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_void_p)(lambda *_: None)
"""A logger that discards the messages of libsimavr."""


class _Avr(Structure):
    """The first fields of the structure avr_t, up to `reset_pc`."""

    _fields_ = [
        ("mmcu", c_char_p),
        ("ioend", c_uint16),
        ("ramend", c_uint16),
        ("flashend", c_uint32),
        ("e2end", c_uint32),
        ("vector_size", c_uint8),
        ("signature", c_uint8 * 3),
        ("fuse", c_uint8 * 6),
        ("lockbits", c_uint8),
        ("rampz", c_uint16),
        ("eind", c_uint16),
        ("address_size", c_uint8),
        ("reset_flags", c_uint32 * 4),
        ("codeend", c_uint32),
        ("state", c_int),
        ("frequency", c_uint32),
        ("millivolts", c_uint32 * 3),
        ("cycle", c_uint64),
        ("run_cycle_count", c_uint64),
        ("run_cycle_limit", c_uint64),
        ("sleep_usec", c_uint32),
        ("time_base", c_uint64),
        ("init", c_void_p),
        ("reset", c_void_p),
        ("custom", c_void_p * 3),
        ("run", c_void_p),
        ("sleep", c_void_p),
        ("irq_count", c_int),
        ("irqs", c_void_p),
        ("sreg", c_uint8 * 8),
        ("interrupt_state", c_int8),
        ("pc", c_uint32),
        ("reset_pc", c_uint32),
    ]


_Timer = CFUNCTYPE(c_uint64, c_void_p, c_uint64, c_void_p)
_WAKE = _Timer(lambda _avr, _when, _param: 0)
"""A timer that is not armed again; the emulator does not sleep past its cycle."""
_Notify = CFUNCTYPE(None, c_void_p, c_uint32, c_void_p)


_AWAKE = ctypes.cast(ctypes.CDLL(None).abs, c_void_p)
"""The sleep function of the emulator: it returns at once, since emulated time is not real time.

Firmware with phase-correct PWM sleeps 250,000 times per emulated second; a Python function would
take longer than all the rest, so this is a C function without effect.
"""


class Avr:
    """One emulated microcontroller from power-on, with `code` in its flash from address 0 on.

    `frequency` is its clock in Hz. `on_answer` is called with each byte that it sends. It begins at
    the address `start` after power-on and each reset, as where fuses choose a boot section. Raises
    EmulatorError if libsimavr is missing, of another version, or does not know the chip.
    """

    def __init__(
        self,
        code: bytes,
        chip: str,
        frequency: int,
        on_answer: Callable[[int], None],
        start: int = 0,
    ) -> None:
        library = _library()
        self.crashed = False
        self._library = library
        self._handle = library.avr_make_mcu_by_name(chip.encode())
        if not self._handle:
            raise EmulatorError(f"simavr does not know the chip {chip}")
        library.avr_init(self._handle)
        self._avr = ctypes.cast(self._handle, POINTER(_Avr)).contents
        if self._avr.sleep != ctypes.cast(library.avr_callback_sleep_raw, c_void_p).value:
            raise EmulatorError(f"{_LIBRARY} is not laid out as version 1.6 is: try {INSTALL}")
        self._avr.frequency = frequency
        self._avr.sleep = _AWAKE
        library.avr_loadcode(self._handle, code, len(code), 0)
        library.avr_ioctl(self._handle, _named("uas0"), byref(c_uint32(0)))  # no flags
        self._notify = _Notify(lambda _irq, value, _param: on_answer(value & 0xFF))
        library.avr_irq_register_notify(self._serial(_OUTPUT), self._notify, None)
        self._input = self._serial(_INPUT)
        self._run = self._avr.run
        self._shorten = _Notify(lambda _irq, value, _param: self._on_watchdog(value))
        control = library.avr_iomem_getirq(self._handle, _WATCHDOG_CONTROL, None, _EVERY_BIT)
        library.avr_irq_register_notify(control, self._shorten, None)
        self._avr.pc = self._avr.reset_pc = start

    @property
    def cycle(self) -> int:
        """Clock cycles since power-on."""
        return int(self._avr.cycle)

    def run_until(self, cycle: int) -> None:
        """Run to that clock cycle, or a few further; crashed firmware does not run any more."""
        avr, run, handle = self._avr, self._library.avr_run, self._handle
        if avr.cycle < cycle:
            self._library.avr_cycle_timer_register(handle, cycle - avr.cycle, _WAKE, None)
        idle = 0
        while (now := avr.cycle) < cycle and not self.crashed:
            avr.run_cycle_limit = cycle - now
            if avr.run != self._run:  # the watchdog is about to reset it
                self._reset()
                continue
            run(handle)
            # Waking up takes one call in which no cycle passes; after a crash none passes at all.
            idle = idle + 1 if avr.cycle == now else 0
            self.crashed = idle > _STUCK

    def reset(self) -> None:
        """Reset it by its reset pin, which its flags tell the firmware; a crash ends by that."""
        self._reset(external=True)
        self.crashed = False

    def receive(self, byte: int, *, spoilt: bool = False) -> None:
        """Let a byte arrive on the serial line, with a framing error if `spoilt`."""
        self._library.avr_raise_irq(self._input, byte | (_FRAMING_ERROR if spoilt else 0))

    def memory(self, address: int) -> int:
        """The byte at an address of the data space: a register, or RAM."""
        return int(self._library.avr_core_watch_read(self._handle, address))

    def close(self) -> None:
        """End the emulator."""
        if self._handle:
            self._library.avr_terminate(self._handle)
            self._handle = None

    def _reset(self, *, external: bool = False) -> None:
        """Reset it, or let its watchdog do it. The emulator clears the flags, the chip adds one."""
        library, handle = self._library, self._handle
        flag = self._avr.reset_flags[_BY_PIN if external else _BY_WATCHDOG]
        register, bit = flag & 0x1FF, flag >> 9 & 7
        flags = self.memory(register) | 1 << bit
        if external:
            self._avr.run = self._run
            library.avr_reset(handle)
        else:
            library.avr_run(handle)
        library.avr_core_watch_write(handle, register, flags)

    def _on_watchdog(self, control: int) -> None:
        """Begin a new period of the watchdog at once; the emulator would wait for the old one."""
        if not control & _CHANGES:
            self._library.avr_ioctl(self._handle, _WATCHDOG_RESET, None)

    def _serial(self, number: int) -> int:
        return int(self._library.avr_io_getirq(self._handle, _named("uar0"), number))


def _named(name: str) -> int:
    """The number of four characters, as the macro AVR_IOCTL_DEF makes it."""
    return int.from_bytes(name.encode(), "big")


_WATCHDOG_RESET = _named("wdtr")


def _library() -> ctypes.CDLL:
    """The library, whose functions know their types. Raises EmulatorError."""
    try:
        library = ctypes.CDLL(_LIBRARY)
    except OSError as error:
        raise EmulatorError(f"simavr is not installed: {INSTALL}") from error
    try:
        library.avr_make_mcu_by_name.restype = c_void_p
        for name in ("avr_init", "avr_run", "avr_terminate"):
            getattr(library, name).argtypes = [c_void_p]
        library.avr_loadcode.argtypes = [c_void_p, c_char_p, c_uint32, c_uint32]
        library.avr_io_getirq.restype = c_void_p
        library.avr_io_getirq.argtypes = [c_void_p, c_uint32, c_int]
        library.avr_irq_register_notify.argtypes = [c_void_p, _Notify, c_void_p]
        library.avr_cycle_timer_register.argtypes = [c_void_p, c_uint64, _Timer, c_void_p]
        library.avr_raise_irq.argtypes = [c_void_p, c_uint32]
        library.avr_reset.argtypes = [c_void_p]
        library.avr_core_watch_write.argtypes = [c_void_p, c_uint16, c_uint8]
        library.avr_iomem_getirq.restype = c_void_p
        library.avr_iomem_getirq.argtypes = [c_void_p, c_uint16, c_char_p, c_int]
        library.avr_core_watch_read.restype = c_uint8
        library.avr_core_watch_read.argtypes = [c_void_p, c_uint16]
        library.avr_ioctl.argtypes = [c_void_p, c_uint32, c_void_p]
        library.avr_global_logger_set(_QUIET)
    except AttributeError as error:
        raise EmulatorError(f"{_LIBRARY} lacks what version 1.6 has: try {INSTALL}") from error
    return library
