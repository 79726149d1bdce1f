"""An examination of a port, or of a host's and a device's tap: first its system, then its line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial

from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.rest import halt
from bilprov.analyzer.doctor.asking import asked, told
from bilprov.analyzer.doctor.finding import Finding, Grade, refused
from bilprov.analyzer.doctor.listening import heard, listened
from bilprov.analyzer.doctor.system import examined, subject
from bilprov.analyzer.taps.sources import Taps
from bilprov.analyzer.transport.errors import LinkError, path_in
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, paths_here
from bilprov.analyzer.transport.signals import Stopper
from bilprov.spec.protocol import Protocol


def of_system(name: str, machine: Machine | None = None) -> Iterator[Finding]:
    """Yield what the system says of the port of that name; nothing for a URL."""
    path = path_in(name)
    if path is not None:
        yield from examined(subject(path, machine or Machine(), paths_here()))


def of_line(
    protocol: Protocol,
    names: Sequence[str],
    settings: LineSettings,
    seconds: float,
    stopper: Stopper,
    rates: Sequence[int] = (),
) -> Iterator[Finding]:
    """Open the ports and yield what is heard in `seconds`; `names` are one, or host and device.

    What is under way when `stopper` stops it is not told, but a device is homed all the same.
    Nothing is sent unless there are `rates`: at each the link check is sent to the first port until
    a device answers, which is homed. Opening raises DTR, which resets an Arduino.
    """
    with ExitStack() as stack:
        try:
            ports = [stack.enter_context(open_port(name, settings)) for name in names]
        except LinkError as error:
            yield refused("opening", error)
            return
        yield Finding("opening", Grade.FINE, f"opened with {settings}")
        taps = Taps(ports[0], ports[1] if len(ports) > 1 else None)
        events = listened(taps, seconds, stopper)
        yield from heard(protocol, taps.names, events, min(seconds, taps.now() / 1e9))
        if rates and not stopper.stopped:
            yield from _of_answers(protocol, ports[0], rates, stopper)


def _of_answers(
    protocol: Protocol, port: Port, rates: Sequence[int], stopper: Stopper
) -> Iterator[Finding]:
    stopper.before_suspending(partial(halt, protocol, port))
    try:
        found = asked(protocol, PortLink(port), port.set_baud, rates, lambda: stopper.stopped)
    except LinkError as error:
        yield refused("answers", error)
        return
    if found or not stopper.stopped:
        yield from told(protocol, port.name, rates, found)
