"""Sources of chunks and line events with times: passive taps, which never write, and a bridge.

And a simulated drive to look at without a device: a host's seeded instructions, and the answers.

A source polls its ports in one loop; all times `t` are in ns (monotonic) since it was made.
"""

from __future__ import annotations

import select
import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from random import Random
from typing import Any, Final, NamedTuple, TypeAlias

from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request, faulty_request
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import Machine, same_line
from bilprov.analyzer.transport.port import Forward, Openings, Port, open_port, open_pty
from bilprov.analyzer.transport.replug import LOOK_AGAIN, Place
from bilprov.captures.closing import Closing
from bilprov.captures.schemas import MS, Chunk, Direction, Line
from bilprov.captures.text import printable
from bilprov.captures.wall_clock import LONGEST, wall_clock
from bilprov.spec.protocol import Protocol

Events: TypeAlias = list[Chunk | Line]

SIDES: Final[tuple[Direction, ...]] = ("host", "device")

LATE = 250_000_000  # ns; a reader that comes so much too late does not know when the bytes came
_COUNT_EVERY = 100_000_000  # ns between readings of a driver's error counts
GATHERED = 30_000_000  # ns of a busy line that are handled at once: shown, that is still now
_BUSY = 120  # bytes in that time: with fewer each read is handled at once
_LINGER = 300_000  # ns that a bridge waits for an answer before what was said is decoded
_MOST_LINGER = 5_000_000  # ns for which it goes on to do so
MOST_AT_ONCE = 1 << 14  # bytes that are handled at once: it takes a millisecond, a pty holds 4 KiB
_RETRY = 0.005  # s between attempts to forward bytes that a peer did not take


def counted(
    t: int, tap: Direction, before: Mapping[str, int], after: Mapping[str, int]
) -> Iterator[Line]:
    """Yield a Line event for each kind of error that a driver has counted since `before`."""
    for kind, total in after.items():
        more = total - before.get(kind, 0)
        if more > 0:
            yield Line(t, kind, tap, f"{more} counted by the driver")


class Source(Closing):
    """A source of events: a clock, and one port per direction with its error counts.

    `names` are the names of the ports by role, `heard` the directions that are listened to, and
    `served` the name under which the host program opens the source, "" if there is none.
    `one_clock` is true if one clock stamps both directions; `attached` is true if traffic may have
    passed before listening began.

    A port that is lost (a Line event `unplugged`) is opened again once it is there again (see
    `Place`), which is a Line event `reconnected`.
    """

    heard: frozenset[Direction] = frozenset({"host", "device"})
    one_clock = False
    attached = True
    served = ""
    linger = 0, 0
    """How long (ns) more is waited for after a read, and for how long this goes on."""

    def __init__(self, ports: Mapping[Direction, Port]) -> None:
        self.names = {str(tap): port.name for tap, port in ports.items()}
        self._ports = dict(ports)  # the ports that are not lost, host before device
        self._settings = {tap: port.settings for tap, port in ports.items()}
        self._places = {tap: Place(port.name) for tap, port in ports.items()}
        self._looked_at = 0.0
        self.seen = 0  # ns; up to when it is known what came
        self._came = 0  # bytes
        self.busy = False  # whether more than 4 kB/s come
        self._rated = 0, 0  # when (ns) it was last looked at whether the line is busy; `_came` then
        self._counts = {tap: port.error_counts() for tap, port in ports.items()}
        self.start_wall = wall_clock()
        self._start = self._counted_at = time.monotonic_ns()

    @property
    def ended(self) -> bool:
        """Whether all ports are lost; one that is there again is opened by `poll`."""
        return not self._ports

    def now(self) -> int:
        """Return the time since the start in ns."""
        return time.monotonic_ns() - self._start

    def poll(self, timeout_s: float | None, also: Sequence[int] = ()) -> Events:
        """Return the new events in order, after waiting at most `timeout_s` s for the first.

        `also` are descriptors (such as a Stopper's) that end the wait too. When both sides have
        bytes the host comes first, since an instruction is older than its answer.

        On a line that is busy (more than 4 kB/s), what is read in the 30 ms after the first event
        is returned with it, each read with its own time.

        If this program was stopped or had no time meanwhile, a Line event `waited` with the time up
        to which bytes were read comes before what was read then; without a timeout this cannot be
        noticed.
        """
        events: Events = []
        asked, most = self.now(), self._came + MOST_AT_ONCE
        places = self._places.items()
        missing = [tap for tap, place in places if place.lasts and tap not in self._ports]
        if missing:
            self._reopen(missing, events)
            wait = 0 if events else LOOK_AGAIN
            timeout_s = wait if timeout_s is None else min(timeout_s, wait)
        if missing or not self.ended:
            self._gather(events, timeout_s, also)
            timeout = LONGEST if timeout_s is None else round(timeout_s * 1e9)
            self._note_unread(events, 0, asked, timeout)
            if events:
                self._read_on(events, most, also)
            self._count(events)
        return events

    def _read_on(self, events: Events, most: int, also: Sequence[int]) -> None:
        """Append what comes soon after the first events, until `most` bytes have come in all."""
        since, before = self._rated
        if self.seen - since >= GATHERED:
            self.busy = (self._came - before) * GATHERED >= _BUSY * (self.seen - since)
            self._rated = self.seen, self._came
        pause, longest = (GATHERED, GATHERED) if self.busy else self.linger
        until, came = self.now() + longest, -1
        while came < self._came < most and (now := self.now()) < until and self._ports:
            known, came, timeout = len(events), self._came, min(pause, until - now)
            self._gather(events, timeout / 1e9, also)
            self._note_unread(events, known, now, timeout)

    def _note_unread(self, events: Events, known: int, asked: int, timeout: int) -> None:
        """Put a `waited` before events that came much later than they were asked for (ns).

        The first `known` events came before.
        """
        if len(events) == known:
            self.seen = max(self.seen, min(asked + timeout, self.now()))
            return
        unread = events[known].t - self.seen
        if unread > timeout + LATE:
            why = "this program was stopped, or had no time or a slow disk"
            detail = f"nothing was read for {unread / 1e9:.3f} s: {why}"
            events.insert(known, Line(self.seen, "waited", "", detail))
        self.seen = events[-1].t

    @abstractmethod
    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        """Append the chunks that have come, and the loss of a port, after the wait."""

    def rest(self) -> Events:
        """The events that were held back, at the end."""
        return []

    def close(self) -> None:
        """Close the ports; further calls do nothing."""
        ports = list(self._ports.values())
        self._ports.clear()
        self._places.clear()
        for port in ports:
            port.close()

    def _ready(self, timeout_s: float | None, also: Sequence[Any]) -> list[Any]:
        """Wait for the ports and for `also`; return those that are readable."""
        return select.select([*self._ports.values(), *also], [], [], timeout_s)[0]

    def _read(self, tap: Direction, *, ready: bool) -> Chunk | Line | None:
        """The next chunk of one side, or its `unplugged`; `ready` is as in `Port.read`."""
        try:
            data = self._ports[tap].read(ready=ready)
        except LinkError as error:
            self._ports.pop(tap).close()  # so that its path is free for when it comes back
            return Line(self.now(), "unplugged", tap, str(error))
        return self._chunk(tap, data) if data else None

    def _chunk(self, tap: Direction, data: bytes) -> Chunk:
        self._came += len(data)
        return Chunk(self.now(), tap, data)

    def _reopen(self, missing: Sequence[Direction], events: Events) -> None:
        """Open the ports that are there again; looked at every 0.2 s at most."""
        if time.monotonic() - self._looked_at < LOOK_AGAIN:
            return
        self._looked_at = time.monotonic()
        for tap in missing:
            name = self._places[tap].found()
            if not name:
                continue
            try:
                port = open_port(name, self._settings[tap])
            except LinkError:  # it has just come and is not ours yet, or somebody else was quicker
                continue
            self._places[tap] = Place(name)
            self._counts[tap] = port.error_counts()
            found = {**self._ports, tap: port}
            self._ports = {side: found[side] for side in SIDES if side in found}
            events.append(Line(self.now(), "reconnected", tap, f"{printable(name)} is there again"))

    def _count(self, events: Events) -> None:
        """Append events for new driver errors, at most every 0.1 s; few drivers count errors."""
        if time.monotonic_ns() - self._counted_at < _COUNT_EVERY:
            return
        self._counted_at = time.monotonic_ns()
        for tap, port in self._ports.items():
            before = self._counts[tap]
            after = None if before is None else port.error_counts()
            if before is not None and after is not None:
                events += counted(self.now(), tap, before, after)
                self._counts[tap] = after


def require_two_lines(host: str, device: str) -> None:
    """Raise ValueError if both names mean the same line (also through a symbolic link).

    Call this before opening: opening a path twice would only report that it is in use.
    """
    if same_line(host, device):
        raise ValueError(
            f"host and device are both tapped at {device}; a tap hears one direction, so give two"
        )


class Taps(Source):
    """Two passive taps, or one (with `device` None, for the host alone); they never write.

    If one is lost, the other is still listened to; `ended` is true once both are lost. `close`
    closes the ports.
    """

    def __init__(self, host: Port, device: Port | None) -> None:
        super().__init__({"host": host} if device is None else {"host": host, "device": device})
        self.heard = frozenset(self._ports)

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        ports = dict(self._ports)
        ready = self._ready(timeout_s, also)
        # The device is read first: what it has answered, the host has said by then. So no answer
        # comes before its instruction because of the order of reading.
        answer = self._read("device", ready=True) if ports.get("device") in ready else None
        if "host" in ports and (answer or ports["host"] in ready):
            said = self._read("host", ready=ports["host"] in ready)
            if said:
                events.append(said)
                if isinstance(answer, Chunk):
                    answer = Chunk(said.t, "device", answer.data)
        if answer:
            events.append(answer)


class HalfDuplexTap(Source):
    """A passive tap on one wire that has both directions; they are told apart by the protocol.

    `timeout` (ns) is the longest pause within a frame. Bytes are held back until it is known who
    has sent them.
    """

    one_clock = True

    def __init__(self, port: Port, protocol: Protocol, timeout: int) -> None:
        super().__init__({"host": port})
        self.names = {"wire": port.name}
        self._wire = HalfDuplex(protocol, max(timeout, Machine().least_pause(port.name)))

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        ready = self._ready(timeout_s, also)
        if self._ports.get("host") in ready:
            came = self._read("host", ready=True)
            if isinstance(came, Chunk):
                events += self._wire.feed(came.data, came.t)
            elif came:
                events += [*self._wire.rest(), came]
        events += self._wire.advance(self.now())

    def _note_unread(self, events: Events, known: int, asked: int, timeout: int) -> None:
        super()._note_unread(events, known, asked, timeout)
        if self._wire.since is not None:
            self.seen = min(self.seen, self._wire.since)

    def rest(self) -> Events:
        """The bytes that were held back, at the end."""
        return [*self._wire.rest()]


class Bridge(Source):
    """A pty for the host program, connected to the device's port; every byte is passed on.

    The host program opens `served`; its settings there (baud rate) do not reach the device. It may
    open the pty at any time, which raises DTR at the device as if its port were opened. A side that
    does not read never delays the other side or the recording: bytes it does not take for a second
    are dropped, though they are still recorded. A Line event `gap` reports this on the tap whose
    bytes were dropped. `ended` is true once the device is lost. `close` also closes the port.
    """

    one_clock = True
    attached = False  # no traffic has passed yet through a pty that was just made
    linger = _LINGER, _MOST_LINGER
    """What is done with the events takes longer than a quick device does to answer."""

    def __init__(self, port: Port) -> None:
        super().__init__({"device": port})
        self._pty = open_pty()
        self.served = self._pty.name
        self._openings = Openings(self.served)
        self.names = {"bridge": port.name, "pty": self.served}
        self._name = port.name
        self._to_device = Forward(self._write_some, "the device does not read")
        self._to_host = Forward(self._pty.write_some, "the host program does not read")

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        if self._to_device.owed or self._to_host.owed:
            timeout_s = _RETRY if timeout_s is None else min(timeout_s, _RETRY)
        port = self._ports.get("device")
        ready = self._ready(timeout_s, [self._pty, *self._openings.descriptors, *also])
        if self._openings.taken() and port:
            port.pulse_dtr()
        said = self._pty.read() if self._pty in ready else b""
        if said:
            events.append(self._chunk("host", said))
        self._hand_on(self._to_device, said, "host", events)
        answer = self._read("device", ready=True) if port in ready else None
        if answer:
            events.append(answer)
        answered = answer.data if isinstance(answer, Chunk) else b""
        self._hand_on(self._to_host, answered, "device", events)

    def _write_some(self, data: bytes) -> int:
        if "device" not in self._ports:
            raise LinkError(f"{self._name} is unplugged")
        return self._ports["device"].write_some(data)

    def close(self) -> None:
        """Close the pty and the port; further calls do nothing."""
        self._pty.close()
        self._openings.close()
        super().close()

    def _hand_on(self, forward: Forward, data: bytes, tap: Direction, events: Events) -> None:
        if not data and not forward.owed:
            return
        dropped = forward.push(data, self.now())
        if dropped:
            events.append(Line(self.now(), "gap", tap, dropped))


_FAULTY = 0.1  # of the instructions
_PAUSES = 250, 1_200  # ms between instructions, as a person drives
_LATENCIES = 300, 3_000  # us until an answer
_MOVES = 4  # instructions after one that moves, before the host stops


def drive(protocol: Protocol, byte_time: int, seed: int = 1) -> Iterator[Chunk]:
    """Yield what a host and a conforming device send, without end; `byte_time` is ns a byte.

    The host sends valid requests and makes a mistake now and then; it stops a car that moves.
    """
    chance = Random(seed)
    device = SimulatedDevice(protocol)
    t, moving = 0, 0
    while True:
        t += chance.randint(*_PAUSES) * MS
        if moving > _MOVES:
            frame = bytes([protocol.pad_byte])
        elif chance.random() < _FAULTY:
            frame = faulty_request(protocol, chance)
        else:
            frame = drawn_request(protocol, chance)
        yield Chunk(t, "host", frame)
        t += len(frame) * byte_time
        device.receive(frame, t)
        answer = device.advance(t)
        moving = moving + 1 if protocol.wheels and protocol.directed(device.state()) else 0
        if answer:
            t += chance.randint(*_LATENCIES) * 1_000
            yield Chunk(t, "device", answer)
            t += len(answer) * byte_time


class SimulatedDrive(Source):
    """A source that opens no port: a simulated host drives a simulated device, in real time."""

    one_clock = True
    attached = False

    def __init__(self, protocol: Protocol, settings: LineSettings) -> None:
        super().__init__({})
        self.names = {"simulated": "drive" if protocol.wheels else protocol.device}
        self._chunks = drive(protocol, settings.byte_time)
        self._next = next(self._chunks)

    @property
    def ended(self) -> bool:
        """It never ends."""
        return False

    def _gather(self, events: Events, timeout_s: float | None, also: Sequence[int]) -> None:
        pause = max(0.0, (self._next.t - self.now()) / 1e9)
        self._ready(pause if timeout_s is None else min(pause, timeout_s), also)
        while self._next.t <= self.now():
            events.append(self._next)
            self._next = next(self._chunks)
        self.seen = self.now()  # nothing is missed where the program is late


class Ports(NamedTuple):
    """The names of the ports to listen to: those of two taps or one, of a bridge, or of a wire."""

    host: str | None = None
    device: str | None = None
    bridge: str | None = None
    half_duplex: str | None = None


def opened_tap(ports: Ports, settings: LineSettings, protocol: Protocol, timeout: int) -> Source:
    """Open the tap that was asked for; `timeout` (ns) is the longest pause within a frame.

    Raises ValueError, in one sentence, if not exactly one kind was asked for or one line would be
    tapped twice, LinkError for a port that cannot be opened.
    """
    host, device, bridge, wire = ports
    usages = "HOST [DEVICE] or --bridge PORT or --half-duplex PORT"
    asked = [name for name in (host, bridge, wire) if name is not None]
    if not asked:
        raise ValueError(f"nothing to sniff: give {usages}")
    if len(asked) > 1:
        raise ValueError(f"give either {usages}, only one of them")
    if host is not None and device is not None:
        require_two_lines(host, device)
    with ExitStack() as opened:
        port = opened.enter_context(open_port(asked[0], settings))
        if bridge is not None:
            source: Source = Bridge(port)
        elif wire is not None:
            source = HalfDuplexTap(port, protocol, timeout)
        else:
            source = Taps(port, None if device is None else open_port(device, settings))
        opened.pop_all()
    return source
