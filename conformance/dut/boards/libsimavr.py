"""The few functions of libsimavr that a board takes, through ctypes. The only file that knows it.

Written for libsimavr 1.6, as Debian brings it; another layout of its structures is refused.
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
    c_uint8,
    c_uint16,
    c_uint32,
    c_uint64,
    c_void_p,
)

from conformance.dut.boards.emulator import EmulatorError

INSTALL = "apt-get install simavr"
_LIBRARY = "libsimavr.so.2"
_INPUT, _OUTPUT = 0, 1  # of the serial line's IRQs
_FRAMING_ERROR = 0x8000
_STUCK = 10_000  # turns without time: it has crashed, or sleeps for ever
_QUIET = CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_void_p)(lambda *_: None)
"""What it would say of its own, where nobody reads it."""


class _Avr(Structure):
    """The beginning of avr_t, as far as `sleep`."""

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
    ]


_Timer = CFUNCTYPE(c_uint64, c_void_p, c_uint64, c_void_p)
_WAKE = _Timer(lambda _avr, _when, _param: 0)
"""A timer that is not armed again: the emulator does not sleep past it."""
_Notify = CFUNCTYPE(None, c_void_p, c_uint32, c_void_p)


_AWAKE = ctypes.cast(ctypes.CDLL(None).abs, c_void_p)
"""What it calls to sleep: nobody waits, since the emulator's time is not ours.

Firmware with phase-correct PWM sleeps a quarter of a million times a second of its time, where a
function of Python would take longer than all the rest; so this is one of C that does nothing.
"""


class Avr:
    """One microcontroller at the moment of power-on, with `code` in its flash from address 0 on.

    `on_answer` is called with each byte that it sends. Raises EmulatorError.
    """

    def __init__(
        self, code: bytes, chip: str, frequency: int, on_answer: Callable[[int], None]
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
        self._flags(0)
        self._notify = _Notify(lambda _irq, value, _param: on_answer(value & 0xFF))
        library.avr_irq_register_notify(self._serial(_OUTPUT), self._notify, None)
        self._input = self._serial(_INPUT)

    @property
    def cycle(self) -> int:
        """Clock cycles since power-on."""
        return int(self._avr.cycle)

    def run_until(self, cycle: int) -> None:
        """Run to that cycle, or a few further; firmware that crashed does nothing any more."""
        avr, run, handle = self._avr, self._library.avr_run, self._handle
        if avr.cycle < cycle:
            self._library.avr_cycle_timer_register(handle, cycle - avr.cycle, _WAKE, None)
        idle = 0
        while (now := avr.cycle) < cycle and not self.crashed:
            avr.run_cycle_limit = cycle - now
            run(handle)
            # Waking up takes a turn without time; where it stands still it would do so for ever.
            idle = idle + 1 if avr.cycle == now else 0
            self.crashed = idle > _STUCK

    def receive(self, byte: int, *, spoilt: bool = False) -> None:
        """A byte arrives on the serial line, `spoilt` with a framing error."""
        self._library.avr_raise_irq(self._input, byte | (_FRAMING_ERROR if spoilt else 0))

    def memory(self, address: int) -> int:
        """The byte at an address of the data space: a register, or RAM."""
        return int(self._library.avr_core_watch_read(self._handle, address))

    def close(self) -> None:
        """Give the emulator up."""
        if self._handle:
            self._library.avr_terminate(self._handle)
            self._handle = None

    def _serial(self, number: int) -> int:
        return int(self._library.avr_io_getirq(self._handle, _named("uar0"), number))

    def _flags(self, flags: int) -> None:
        self._library.avr_ioctl(self._handle, _named("uas0"), byref(c_uint32(flags)))


def _named(name: str) -> int:
    """AVR_IOCTL_DEF: four characters as a number."""
    return int.from_bytes(name.encode(), "big")


def _library() -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(_LIBRARY)
    except OSError as error:
        raise EmulatorError(f"simavr is not installed: {INSTALL}") from error
    try:
        return _typed(library)
    except AttributeError as error:
        raise EmulatorError(f"{_LIBRARY} has not what version 1.6 has: try {INSTALL}") from error


def _typed(library: ctypes.CDLL) -> ctypes.CDLL:
    """Say what its functions take and return. Raises AttributeError for one that it has not."""
    library.avr_make_mcu_by_name.restype = c_void_p
    for name in ("avr_init", "avr_run", "avr_terminate"):
        getattr(library, name).argtypes = [c_void_p]
    library.avr_loadcode.argtypes = [c_void_p, c_char_p, c_uint32, c_uint32]
    library.avr_io_getirq.restype = c_void_p
    library.avr_io_getirq.argtypes = [c_void_p, c_uint32, c_int]
    library.avr_irq_register_notify.argtypes = [c_void_p, _Notify, c_void_p]
    library.avr_cycle_timer_register.argtypes = [c_void_p, c_uint64, _Timer, c_void_p]
    library.avr_raise_irq.argtypes = [c_void_p, c_uint32]
    library.avr_core_watch_read.restype = c_uint8
    library.avr_core_watch_read.argtypes = [c_void_p, c_uint16]
    library.avr_ioctl.argtypes = [c_void_p, c_uint32, c_void_p]
    library.avr_global_logger_set(_QUIET)
    return library
