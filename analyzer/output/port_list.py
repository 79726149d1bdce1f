"""Shows the serial ports of a machine as tables that fit 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import table
from bilprov.analyzer.transport.ports import PortInfo
from bilprov.captures.text import printable

_BY_ID = "/dev/serial/by-id"


def drawn(found: Sequence[PortInfo]) -> Iterator[RenderableType]:
    """Yield the tables: each port with its driver and holders, its device, its lasting name."""
    yield table(
        ("", "port", "usb", "driver", "latency", "held by"),
        [
            (
                "*" if port.likely else "",
                printable(port.path),
                port.usb,
                printable(port.driver),
                "" if port.latency_ms is None else f"{port.latency_ms} ms",
                ", ".join(f"{holder.name} (pid {holder.pid})" for holder in port.holders),
            )
            for port in found
        ],
        right="latency",
    )
    for heading, told in (
        ("device", [(port.path, _device(port)) for port in found]),
        (f"name in {_BY_ID}, which stays", [(port.path, Path(port.by_id).name) for port in found]),
    ):
        rows = [(printable(path), printable(said)) for path, said in told if said]
        if rows:
            yield Text()
            yield table(("port", heading), rows)


def _device(port: PortInfo) -> str:
    serial = f"serial {port.serial_number}" if port.serial_number else ""
    return ", ".join(part for part in (port.description, serial) if part)


def unseen(found: Sequence[PortInfo]) -> str:
    """A sentence where other users' processes could not be looked into, else ""."""
    count = max((port.unseen for port in found), default=0)
    if not count:
        return ""
    which = "1 process of another user" if count == 1 else f"{count} processes of other users"
    return f"{which} could not be examined: sudo shows every program that holds a port"
