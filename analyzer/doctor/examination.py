"""An examination of a port, or of a host's and a device's tap: first its system, then its line.

Each check of the system is a row of `CHECKS`; it is made before the port is opened.
The line is listened to for a moment, in which nothing is sent. Where it is asked for, the baud rate
at which a device answers is found by the link check. At each rate stops are sent first: wherever
the bytes arrive garbled, stops are what does least harm. Only where something answers are the other
frames of the link check sent. The device is homed at the end.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import Enum
from functools import partial
from shlex import quote

from bilprov.analyzer.client.operations import Link, done, listen, send
from bilprov.analyzer.client.port_link import PortLink
from bilprov.analyzer.client.rest import halt, home_once
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.finding import Finding, Grade, refused
from bilprov.analyzer.taps.sources import Events, Source, Taps
from bilprov.analyzer.transport.errors import (
    NO_BRAILLE,
    LinkError,
    busy,
    denied,
    missing,
    opening_failed,
    path_in,
)
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import MODEM_MANAGER, Held, Machine, for_braille
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, paths_here
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.captures.text import printable, quantity
from bilprov.spec.by_effect import link_check
from bilprov.spec.codec import judge, spaced
from bilprov.spec.protocol import Protocol

LATENCY_LIMIT = 4
"""Ms for which an adapter may hold bytes back before that is worth a word; FTDI's are set to 16."""

_IGNORED_BY_MODEM_MANAGER = ("ID_MM_DEVICE_IGNORE", "ID_MM_PORT_IGNORE")
_RULES = "/etc/udev/rules.d/78-bilprov.rules"


@dataclass(frozen=True, slots=True)
class Subject:
    """The port that is examined: its name, the machine, the ports there are, who holds it."""

    name: str
    machine: Machine
    ports_here: Sequence[str]
    held: Held

    @property
    def device(self) -> str:
        """The path of its device, quoted for a shell."""
        return quote(self.machine.device(self.name))


def subject(name: str, machine: Machine, ports_here: Sequence[str]) -> Subject:
    """The port of that name as the machine has it now."""
    return Subject(name, machine, ports_here, machine.held(name)[name])


def _there(port: Subject) -> Finding | None:
    if port.name and port.machine.file(port.machine.device(port.name)).exists():
        return None
    return refused("there", missing(port.name, port.ports_here, port.machine))


def _terminal(port: Subject) -> Finding | None:
    if port.machine.is_terminal(port.name):
        return None
    folder = port.machine.file(port.machine.device(port.name)).is_dir()
    error = OSError(errno.EISDIR if folder else errno.ENOTTY, "")
    return refused("serial port", opening_failed(port.name, error, "", ()))


def _permission(port: Subject) -> Finding:
    if not port.machine.may_open(port.name):
        return refused("permission", denied(port.name, port.machine))
    return Finding("permission", Grade.FINE, "you may open it")


def _holder(port: Subject) -> Finding:
    if port.held.holders:
        return refused("holder", busy(port.name, port.held, port.machine))
    if port.held.unseen:
        many = "process is" if port.held.unseen == 1 else "processes are"
        sentence = (
            f"none of your programs holds it; {port.held.unseen} {many} other users' and cannot be "
            "looked into; this names all who hold it"
        )
        return Finding("holder", Grade.UNSEEN, sentence, f"sudo fuser -v {port.device}")
    return Finding("holder", Grade.FINE, "nobody else holds it")


def _pty(port: Subject) -> Finding | None:
    if not port.machine.is_pty(port.name):
        return None
    server = f", served by {port.held.server}" if port.held.server else ""
    sentence = f"a pseudo terminal{server}: it has no baud rate, no parity and no modem lines"
    return Finding("pty", Grade.FINE, sentence)


def _modem_manager(port: Subject) -> Finding | None:
    usb = port.machine.usb(port.name)
    if usb is None:
        return None
    says = port.machine.properties(port.name)
    ignored = any(says.get(tag, "0") != "0" for tag in _IGNORED_BY_MODEM_MANAGER)
    if ignored or not port.machine.running(MODEM_MANAGER):
        return Finding("ModemManager", Grade.FINE, "ModemManager leaves it alone")
    sentence = (
        f"ModemManager is running, has no rule to leave {port.name} alone, and may send it modem "
        "commands, which a robot takes for instructions"
    )
    rule = (
        f'ATTRS{{idVendor}}=="{usb.vendor}", ATTRS{{idProduct}}=="{usb.product}", '
        'ENV{ID_MM_DEVICE_IGNORE}="1"'
    )
    command = (
        f"echo {quote(rule)} | sudo tee -a {_RULES} && sudo udevadm control --reload && "
        "sudo udevadm trigger"
    )
    return Finding("ModemManager", Grade.ADVICE, sentence, command)


def _brltty(port: Subject) -> Finding | None:
    if not for_braille(port.machine.properties(port.name)):
        return None
    sentence = (
        f"udev's rules take {port.name} for a Braille display, and brltty may take it away at any "
        "moment; where nobody needs one, end it"
    )
    return Finding("brltty", Grade.ADVICE, sentence, NO_BRAILLE)


def _latency_timer(port: Subject) -> Finding | None:
    milliseconds = port.machine.latency_timer(port.name)
    if milliseconds is None:
        return None
    if milliseconds <= LATENCY_LIMIT:
        sentence = f"its adapter holds bytes back for at most {milliseconds} ms"
        return Finding("latency timer", Grade.FINE, sentence)
    sentence = (
        f"the adapter of {port.name} holds bytes back for up to {milliseconds} ms, so times of "
        "answers are that uncertain"
    )
    file = quote(f"/sys/bus/usb-serial/devices/{port.machine.title(port.name)}/latency_timer")
    return Finding("latency timer", Grade.ADVICE, sentence, f"echo 1 | sudo tee {file}")


FIRST = (_there, _terminal)
"""The checks after which no others are made where their finding blocks."""

CHECKS = (
    *FIRST,
    _pty,
    _permission,
    _holder,
    _modem_manager,
    _brltty,
    _latency_timer,
)


def _shared(port: Subject) -> Finding | None:
    if not port.held.holders:
        return None
    error = busy(port.name, port.held, port.machine)
    sentence = f"{error.sentence}, since each of the two loses what the other reads"
    return Finding("holder", Grade.ADVICE, sentence, error.command)


# What is worth a word where a port was opened all the same.
_IN_USE = (_shared, _modem_manager, _brltty, _latency_timer)


def examined(port: Subject) -> Iterator[Finding]:
    """Make every check of a port, in their order; nothing is opened or changed."""
    for check in CHECKS:
        finding = check(port)
        if finding is not None:
            yield finding
            if check in FIRST and finding.grade is Grade.BLOCKS:
                return


def notes(name: str, machine: Machine | None = None) -> list[str]:
    """What a command that uses the port should tell its user, a line each.

    Only the port of a USB adapter or board has any; nothing else is looked at for other ports.
    """
    machine = machine or Machine()
    path = path_in(name)
    if path is None or machine.usb(path) is None:
        return []
    port = subject(path, machine, ())
    findings = (look(port) for look in _IN_USE)
    return [one.note(path) for one in findings if one and one.grade is Grade.ADVICE]


_TEXT = re.compile(rb"[\t\r\n\x20-\x7e]{8,}")  # as boards print while they boot
# What errors that a driver counts mean.
_MEANS = {
    "framing": "another baud rate or other stop bits are on the line; find the rate, give --baud",
    "parity": "the line has another parity; give --parity",
    "overrun": "bytes arrive faster than they are read; is the machine too busy?",
}
_LEAST_ANSWERS = 5  # of which it is told whether they fit
_FIT, _MISFIT = 0.8, 0.5  # shares of answers that are the expected ones
_OTHER: dict[Direction, Direction] = {"host": "device", "device": "host"}


def listened(source: Source, seconds: float, stopper: Stopper) -> Events:
    """Give what is heard on the taps within `seconds`, or until Ctrl-C or the end of all ports."""
    events: Events = []
    end = round(seconds * 1e9)
    while not stopper.stopped and not source.ended and (left := end - source.now()) > 0:
        events += source.poll(min(left / 1e9, 0.1), [stopper.fileno()])
    return events


def heard(
    protocol: Protocol, names: Mapping[str, str], events: Sequence[Chunk | Line], seconds: float
) -> Iterator[Finding]:
    """Yield what the events of `seconds` say of the line.

    `names` are those of the ports, by the direction that each hears: one or two.
    """
    data = {side: _said(events, side) for side in names}
    count = sum(map(len, data.values()))
    for event in events:
        if isinstance(event, Line) and event.event == "unplugged":
            last = printable(data[event.tap].decode("latin-1").strip())
            said = f"it sent {last!r}, then " if last else ""
            yield Finding("line", Grade.BLOCKS, said + event.detail)
    yield from _miscounted(names, events, count)
    if not count:
        why = "a device speaks only when it is asked" if len(names) == 1 else "does the host drive?"
        sentence = f"not a byte was heard in {seconds:.3g} s: {why}"
        yield Finding("traffic", Grade.UNSEEN, sentence)
        return
    for side, told in data.items():
        found = _TEXT.search(told)
        if found and len(found[0]) * 2 > len(told) and not _is_traffic(protocol, told):
            text = printable(found[0].decode("ascii").strip())
            sentence = f"{names[side]} carries text, which is another protocol: {text!r}"
            yield Finding("traffic", Grade.ADVICE, sentence)
            return
    if len(names) > 1:
        yield _wired(protocol, names, events, data)
    else:
        sentence = f"{quantity(count, 'byte')} came in {seconds:.3g} s"
        yield Finding("traffic", Grade.FINE, sentence)


def _is_traffic(protocol: Protocol, data: bytes) -> bool:
    """Whether most of the bytes are valid frames, some of which look like text too."""
    session = Session(protocol, heard=frozenset({"host"}))
    records = [*session.feed(Chunk(0, "host", data)), *session.finish()]
    frames = (record for record in records if isinstance(record, HostRecord))
    valid = sum(len(one.data) for one in frames if one.judgement and one.judgement.valid)
    return 2 * valid >= len(data)


def _said(events: Sequence[Chunk | Line], side: str) -> bytes:
    chunks = (event for event in events if isinstance(event, Chunk))
    return b"".join(chunk.data for chunk in chunks if chunk.direction == side)


def _miscounted(
    names: Mapping[str, str], events: Sequence[Chunk | Line], count: int
) -> Iterator[Finding]:
    """Errors that the driver has counted: framing errors mean another baud rate."""
    lines = [event for event in events if isinstance(event, Line)]
    for kind, means in _MEANS.items():
        errors = sum(int(line.detail.split()[0]) for line in lines if line.event == kind)
        if errors:
            counted = quantity(errors, f"{kind} error")
            sentence = f"the driver counted {counted} in {quantity(count, 'byte')}: {means}"
            (name, *others) = names.values()
            asks = kind == "framing" and not others
            command = f"bilprov ports {quote(name)} --ask --yes" if asks else ""
            yield Finding("line errors", Grade.BLOCKS, sentence, command)


def _wired(
    protocol: Protocol,
    names: Mapping[str, str],
    events: Sequence[Chunk | Line],
    data: Mapping[str, bytes],
) -> Finding:
    """Whether two taps are wired as they were named, by whose bytes answer whose."""
    chunks = [event for event in events if isinstance(event, Chunk)]
    codes = {spec.code for spec in protocol.responses}
    if data["host"] == data["device"] and not set(data["host"]) <= codes:
        sentence = "both taps hear the same bytes: they are on one wire, or the line is an echo"
        command = f"bilprov sniff --half-duplex {quote(names['host'])}"
        return Finding("taps", Grade.BLOCKS, sentence, command)
    straight, count = _fitting(protocol, chunks)
    turned, turned_count = _fitting(
        protocol, [Chunk(chunk.t, _OTHER[chunk.direction], chunk.data) for chunk in chunks]
    )
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


RATES = (9600, 19200, 38400, 57600, 115200, 230400, 250000, 460800, 500000, 921600, 1000000)
"""Baud rates that devices of this kind are set to, in bits/s."""

_ROUNDS = 2  # a board that was reset when its port was opened boots during the first


class Reply(Enum):
    """What came back at one baud rate."""

    NOTHING = "nothing"
    GARBAGE = "bytes that are not answers"
    ECHO = "what was sent"
    ANSWERS = "answers"


@dataclass(frozen=True, slots=True)
class Answered:
    """What came back to the link check at one baud rate: each frame, and the bytes after it."""

    baud: int
    reply: Reply
    exchanges: tuple[tuple[bytes, bytes], ...] = ()


def rates_of(name: str, baud: int) -> tuple[int, ...]:
    """The baud rates to ask at: `baud` first, and no other where the port has none to be set."""
    if name.lower().startswith(("socket:", "loop:")):
        return (baud,)
    return (baud, *(rate for rate in RATES if rate != baud))


def longest_time(protocol: Protocol, rates: Sequence[int]) -> float:
    """The time in s that asking at these rates takes if nobody answers."""
    return _ROUNDS * len(rates) * protocol.timing.answer_longest / 1000


def asked(
    protocol: Protocol,
    link: Link,
    tune: Callable[[int], object],
    rates: Sequence[int],
    given_up: Callable[[], bool] = lambda: False,
) -> tuple[Answered, ...]:
    """Ask at each rate until answers come; give what came back, the last at the rate that is left.

    `tune` sets the line's baud rate, and raises LinkError for one that it does not have; `given_up`
    is called before each rate. A device that answers is homed at the end, and on every way out
    stops are sent at the last rate. Raises LinkError if the port is lost.
    """
    found: list[Answered] = []
    try:
        for rate in (*rates,) * _ROUNDS:
            if given_up():
                break
            try:
                tune(rate)
            except LinkError:
                continue
            answered = _link_check(protocol, link, rate, expected=rate == rates[0])
            if answered.reply is not Reply.NOTHING:
                found.append(answered)
            if answered.reply in (Reply.ANSWERS, Reply.ECHO):
                break
        else:
            tune(rates[0])
    finally:
        with suppress(LinkError):
            done(home_once(protocol), link)
    return tuple(found)


def _link_check(protocol: Protocol, link: Link, rate: int, *, expected: bool) -> Answered:
    """Home the device and, if anything comes back, send the link check.

    At another rate than the `expected` one a stray 0 is no proof: a refusal has to be right too.
    """
    if not done(home_once(protocol), link):
        return Answered(rate, Reply.NOTHING)
    setting, unused, short = link_check(protocol)
    longest, more = (
        round(milliseconds * MS)
        for milliseconds in (protocol.timing.answer_longest, protocol.timing.answer_deadline)
    )
    exchanges = []
    for frame in filter(None, (unused, setting, short)):
        done(send(frame), link)
        came = [*done(listen(1, longest), link).codes, *done(listen(None, more), link).codes]
        exchanges.append((frame, bytes(came)))
    codes = {spec.code for spec in protocol.responses}
    due = {frame: judge(protocol, frame).response.code for frame, _ in exchanges}
    sure = any(due[frame] and came == bytes([due[frame]]) for frame, came in exchanges)
    single = all(len(came) <= 1 and set(came) <= codes for _, came in exchanges)
    if all(came[: len(frame)] == frame for frame, came in exchanges):
        reply = Reply.ECHO
    elif single and (sure or expected) and any(came for _, came in exchanges):
        reply = Reply.ANSWERS
    else:
        reply = Reply.GARBAGE
    return Answered(rate, reply, tuple(exchanges))


def told(
    protocol: Protocol, name: str, rates: Sequence[int], found: Sequence[Answered]
) -> Iterator[Finding]:
    """Yield what asking at the rates has shown of the device at the port `name`."""
    last = found[-1] if found else None
    if last is None:
        tried = f"any of {len(rates)} baud rates" if len(rates) > 1 else f"{rates[0]} baud"
        sentence = f"nobody answers at {tried}: check power, wiring (TX to RX) and common ground"
        yield Finding("answers", Grade.BLOCKS, sentence)
    elif last.reply is Reply.ECHO:
        sentence = (
            "what is sent comes back: a loop-back plug, TX and RX wired together, or an adapter "
            "that hears itself"
        )
        yield Finding("echo", Grade.BLOCKS, sentence)
    elif last.reply is Reply.GARBAGE:
        came = " ".join(spaced(answer) for _, answer in last.exchanges if answer)[:60]
        asked = dict.fromkeys(one.baud for one in found)  # each is asked at twice
        sentence = (
            f"something comes back at {', '.join(map(str, asked))} baud, but no "
            f"answers ({came}): another baud rate, parity or protocol"
        )
        yield Finding("answers", Grade.BLOCKS, sentence)
    else:
        yield _at_rate(name, rates[0], last.baud)
        yield from _unlike(protocol, name, last)


def _at_rate(name: str, expected: int, baud: int) -> Finding:
    if baud == expected:
        return Finding("answers", Grade.FINE, f"a device answers at {baud} baud")
    sentence = f"a device answers at {baud} baud, not at {expected}; give each command that rate"
    command = f"bilprov conform {quote(name)} --baud {baud}"
    return Finding("baud rate", Grade.BLOCKS, sentence, command)


def _unlike(protocol: Protocol, name: str, answered: Answered) -> Iterator[Finding]:
    """The first answer that is another one than a conforming device gives."""
    for frame, came in answered.exchanges:
        due = judge(protocol, frame).response
        if came != bytes([due.code]):
            what = f"answers {spaced(came)}" if came else "gives no answer"
            sentence = f"to {spaced(frame)} it {what}, where {due.code:02x} {due.name} is due"
            command = f"bilprov conform {quote(name)} --level smoke --baud {answered.baud}"
            yield Finding("answers", Grade.ADVICE, sentence, command)
            return


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
