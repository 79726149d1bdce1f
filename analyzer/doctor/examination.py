"""An examination of a port, or of a host's and a device's tap: first its system, then its line.

The system is looked at before the port is opened. The line is listened to for a moment, in which
nothing is sent.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from shlex import quote

from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.finding import Finding, Grade, refused
from bilprov.analyzer.taps.sources import Events, Taps
from bilprov.analyzer.transport.errors import (
    LinkError,
    busy,
    denied,
    missing,
    opening_failed,
    path_in,
)
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import MODEM_MANAGER, Machine, paths_here
from bilprov.analyzer.transport.port import open_port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.captures.text import quantity
from bilprov.spec.protocol import Protocol

LATENCY_LIMIT = 4
"""Ms for which an adapter may hold bytes back before that is worth a word; FTDI's are set to 16."""

_IGNORED_BY_MODEM_MANAGER = ("ID_MM_DEVICE_IGNORE", "ID_MM_PORT_IGNORE")
_RULES = "/etc/udev/rules.d/78-bilprov.rules"


def examined(name: str, machine: Machine, ports_here: Sequence[str]) -> Iterator[Finding]:
    """Make every check of a port, in their order; nothing is opened or changed.

    `ports_here` are the ports of the machine. Where the name leads to no serial port, nothing else
    is checked.
    """
    file = machine.file(machine.device(name))
    if not (name and file.exists()):
        yield refused("there", missing(name, ports_here, machine))
        return
    if not machine.is_terminal(name):
        error = OSError(errno.EISDIR if file.is_dir() else errno.ENOTTY, "")
        yield refused("serial port", opening_failed(name, error, ""))
        return
    if machine.may_open(name):
        yield Finding("permission", Grade.FINE, "you may open it")
    else:
        yield refused("permission", denied(name, machine))
    held = machine.held(name)[name]
    if held.holders:
        yield refused("holder", busy(name, held, machine))
    elif held.unseen:
        many = "process is" if held.unseen == 1 else "processes are"
        sentence = (
            f"none of your programs holds it; {held.unseen} {many} other users' and cannot be "
            "looked into; this names all who hold it"
        )
        command = f"sudo fuser -v {quote(machine.device(name))}"
        yield Finding("holder", Grade.UNSEEN, sentence, command)
    else:
        yield Finding("holder", Grade.FINE, "nobody else holds it")
    yield from _of_adapter(name, machine)


def _of_adapter(name: str, machine: Machine) -> Iterator[Finding]:
    """Who may take a USB adapter for a modem, and for how long it holds bytes back."""
    usb = machine.usb(name)
    if usb is not None:
        says = machine.properties(name)
        ignored = any(says.get(tag, "0") != "0" for tag in _IGNORED_BY_MODEM_MANAGER)
        if ignored or not machine.running(MODEM_MANAGER):
            yield Finding("ModemManager", Grade.FINE, "ModemManager leaves it alone")
        else:
            sentence = (
                f"ModemManager is running, has no rule to leave {name} alone, and may send it "
                "modem commands, which a robot takes for instructions"
            )
            rule = (
                f'ATTRS{{idVendor}}=="{usb.vendor}", ATTRS{{idProduct}}=="{usb.product}", '
                'ENV{ID_MM_DEVICE_IGNORE}="1"'
            )
            command = (
                f"echo {quote(rule)} | sudo tee -a {_RULES} && sudo udevadm control --reload && "
                "sudo udevadm trigger"
            )
            yield Finding("ModemManager", Grade.ADVICE, sentence, command)
    milliseconds = machine.latency_timer(name)
    if milliseconds is not None and milliseconds <= LATENCY_LIMIT:
        sentence = f"its adapter holds bytes back for at most {milliseconds} ms"
        yield Finding("latency timer", Grade.FINE, sentence)
    elif milliseconds is not None:
        sentence = (
            f"the adapter of {name} holds bytes back for up to {milliseconds} ms, so times of "
            "answers are that uncertain"
        )
        timer = quote(f"/sys/bus/usb-serial/devices/{machine.title(name)}/latency_timer")
        yield Finding("latency timer", Grade.ADVICE, sentence, f"echo 1 | sudo tee {timer}")


def notes(name: str, machine: Machine | None = None) -> list[str]:
    """What a command that uses the port should tell its user, a line each.

    Only the port of a USB adapter or board has any; nothing else is looked at for other ports.
    """
    machine = machine or Machine()
    path = path_in(name)
    if path is None or machine.usb(path) is None:
        return []
    found = []
    held = machine.held(path)[path]
    if held.holders:  # it was opened all the same
        error = busy(path, held, machine)
        sentence = f"{error.sentence}, since each of the two loses what the other reads"
        found.append(Finding("holder", Grade.ADVICE, sentence, error.command))
    found += _of_adapter(path, machine)
    return [one.note(path) for one in found if one.grade is Grade.ADVICE]


# What errors that a driver counts mean.
_MEANS = {
    "framing": "another baud rate or other stop bits are on the line; find the rate, give --baud",
    "parity": "the line has another parity; give --parity",
    "overrun": "bytes arrive faster than they are read; is the machine too busy?",
}
_LEAST_ANSWERS = 5  # of which it is told whether they fit
_FIT, _MISFIT = 0.8, 0.5  # shares of answers that are the expected ones
_OTHER: dict[Direction, Direction] = {"host": "device", "device": "host"}


def heard(
    protocol: Protocol, names: Mapping[str, str], events: Sequence[Chunk | Line], seconds: float
) -> Iterator[Finding]:
    """Yield what the events of `seconds` say of the line.

    `names` are those of the ports, by the direction that each hears: one or two.
    """
    chunks = [event for event in events if isinstance(event, Chunk)]
    lines = [event for event in events if isinstance(event, Line)]
    data = {
        side: b"".join(chunk.data for chunk in chunks if chunk.direction == side) for side in names
    }
    count = sum(map(len, data.values()))
    for line in lines:
        if line.event == "unplugged":
            yield Finding("line", Grade.BLOCKS, line.detail)
    for kind, means in _MEANS.items():
        errors = sum(int(line.detail.split()[0]) for line in lines if line.event == kind)
        if errors:
            counted = quantity(errors, f"{kind} error")
            sentence = f"the driver counted {counted} in {quantity(count, 'byte')}: {means}"
            yield Finding("line errors", Grade.BLOCKS, sentence)
    if not count:
        why = "a device speaks only when it is asked" if len(names) == 1 else "does the host drive?"
        sentence = f"not a byte was heard in {seconds:.3g} s: {why}"
        yield Finding("traffic", Grade.UNSEEN, sentence)
        return
    if len(names) > 1:
        yield _wired(protocol, names, chunks, data)
    else:
        sentence = f"{quantity(count, 'byte')} came in {seconds:.3g} s"
        yield Finding("traffic", Grade.FINE, sentence)


def _wired(
    protocol: Protocol,
    names: Mapping[str, str],
    chunks: Sequence[Chunk],
    data: Mapping[str, bytes],
) -> Finding:
    """Whether two taps are wired as they were named, by whose bytes answer whose."""
    codes = {spec.code for spec in protocol.responses}
    if data["host"] == data["device"] and not set(data["host"]) <= codes:
        sentence = "both taps hear the same bytes: they are on one wire, or the line is an echo"
        command = f"bilprov sniff --half-duplex {quote(names['host'])}"
        return Finding("taps", Grade.BLOCKS, sentence, command)
    straight, count = _fitting(protocol, chunks)
    swapped = [Chunk(chunk.t, _OTHER[chunk.direction], chunk.data) for chunk in chunks]
    turned, turned_count = _fitting(protocol, swapped)
    if turned_count >= _LEAST_ANSWERS and turned >= _FIT and straight < _MISFIT:
        sentence = (
            f"the taps are swapped: read the other way round, {turned:.0%} of the answers are the "
            f"expected ones, this way {straight:.0%}; give them in the other order"
        )
        command = f"bilprov sniff {quote(names['device'])} {quote(names['host'])}"
        return Finding("taps", Grade.BLOCKS, sentence, command)
    if count < _LEAST_ANSWERS:
        heard_of = quantity(count, "answer")
        sentence = f"only {heard_of} came, too few to decide whether the taps are swapped"
        return Finding("taps", Grade.UNSEEN, sentence)
    if straight < _MISFIT:
        sentence = (
            f"{straight:.0%} of {count} answers are the expected ones, either way round: another "
            "baud rate, another protocol, or a device that errs"
        )
        return Finding("taps", Grade.ADVICE, sentence)
    return Finding("taps", Grade.FINE, f"{straight:.0%} of {count} answers are the expected ones")


def _fitting(protocol: Protocol, chunks: Sequence[Chunk]) -> tuple[float, int]:
    """The share of the device's bytes that are the expected answers, and how many bytes it sent."""
    session = Session(protocol, attached=True)
    records = [record for chunk in chunks for record in session.feed(chunk)]
    answers = [one for one in (*records, *session.finish()) if isinstance(one, DeviceRecord)]
    return sum(bool(one.agrees) for one in answers) / max(1, len(answers)), len(answers)


def of_system(name: str) -> Iterator[Finding]:
    """Yield what the system says of the port of that name; nothing for a URL."""
    path = path_in(name)
    if path is not None:
        yield from examined(path, Machine(), paths_here())


def of_line(
    protocol: Protocol,
    names: Sequence[str],
    settings: LineSettings,
    seconds: float,
    stopper: Stopper,
) -> Iterator[Finding]:
    """Open the ports and yield what is heard in `seconds`; `names` are one, or host and device.

    Nothing is sent. Opening raises DTR, which resets an Arduino.
    """
    with ExitStack() as stack:
        try:
            ports = [stack.enter_context(open_port(name, settings)) for name in names]
        except LinkError as error:
            yield refused("opening", error)
            return
        yield Finding("opening", Grade.FINE, f"opened with {settings}")
        taps = Taps(ports[0], ports[1] if len(ports) > 1 else None)
        events: Events = []
        end = round(seconds * 1e9)
        while not stopper.stopped and not taps.ended and (left := end - taps.now()) > 0:
            events += taps.poll(min(left / 1e9, 0.1), [stopper.fileno()])
        yield from heard(protocol, taps.names, events, min(seconds, taps.now() / 1e9))
