"""Faults of the serial line: an echo, a dead line, lost flow-control bytes."""

from __future__ import annotations

from collections.abc import Iterator

from bilprov.conformance.dut.fault import Fault, MutatedDevice
from bilprov.conformance.mutation.faults.vocabulary import EVERYTHING
from bilprov.spec.protocol import Protocol


def line_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield the faults of the serial line."""
    family = "line"

    def echo(device: MutatedDevice, data: bytes, now: int) -> bytes:
        for byte in data:
            device.answer(byte, now)
        return b""

    yield Fault("echo", family, "sends back what it gets: a loop-back plug", exit=2, hear=echo)
    yield Fault("dead", family, "never answers anything", exit=2, hear=lambda d, data, now: b"")
    xon, xoff = 0x11, 0x13
    yield Fault(
        "xon-xoff",
        family,
        "its line eats the flow-control bytes XON and XOFF",
        EVERYTHING,
        hear=lambda d, data, now: bytes(b for b in data if b not in (xon, xoff)),
    )
