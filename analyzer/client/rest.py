"""Brings a device to rest: a car by stops, another one by the requests that its grammar has.

As many stops as the longest frame has bytes bring a robot of the car's family to rest from any
state.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from bilprov.analyzer.client.operations import Ended, Procedure, listen, send
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.captures.schemas import MS
from bilprov.spec.codec import Judgement, build, judge
from bilprov.spec.protocol import Protocol
from bilprov.spec.replies import reply_size
from bilprov.spec.state import State

_SLOWER = 4  # how much later than the first answer one of the others may come
_SETTLE = 2 * MS  # ns after the last answer in which a surplus answer comes


def stops(protocol: Protocol) -> bytes:
    """Stop instructions, as many as the longest frame has bytes.

    They fill any open frame, and at least one is left over as an instruction.
    """
    return bytes([protocol.pad_byte]) * protocol.longest_frame


def nobody_words(protocol: Protocol, port: str = "") -> str:
    """The sentence for a device that does not answer, at a port where it has one."""
    where = f" at {port}" if port else ""
    return f"nobody answers{where}; is the {protocol.device} on, and is it the right port?"


def home_once(protocol: Protocol) -> Procedure[bool]:
    """Send stops to complete any frame the robot may be in; return whether it answered.

    Stops that the robot takes as missing data have no answer of their own, so the wait ends after
    a pause without an answer. The first answer's latency lengthens that pause for a slow robot.
    """
    timing = protocol.timing
    yield from listen(None, 0)
    sent = yield from send(stops(protocol))
    heard = 0
    patience = round(timing.answer_longest * MS)
    pause = round(max(timing.answer_deadline, timing.truncation_timeout) * MS)
    while heard < protocol.longest_frame:
        more = yield from listen(1, patience)
        if not more.answers:
            break
        if not heard:
            patience = max(pause, _SLOWER * (more.answers[0][0] - sent))
        heard += len(more.answers)
    yield from listen(None, _SETTLE)
    return heard > 0


def exchange(protocol: Protocol, asked: Judgement, patience: int, pause: int) -> Procedure[bytes]:
    """Send a request and return what is heard until its answer is whole; b"" if none is due.

    The first byte may take `patience` ns, each of the others `pause` ns.
    """
    yield from send(asked.frame)
    held = bytearray()
    while asked.answer_due:
        size = reply_size(protocol, bytes(held), asked) if held else None
        if size is not None and size <= len(held):
            break
        missing = size - len(held) if size else 1
        heard = yield from listen(missing, pause if held else patience)
        if not heard.answers:
            break
        held += bytes(heard.codes)
    return bytes(held)


class Rest:
    """Brings a device to rest: a robot of the car's family by stops, also in the middle of a frame.

    Each other device that was spoken to, by the requests that its grammar has for it; where no
    request does that, nothing is done.
    """

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._part = protocol.layout.part("address")
        self._stops = stops(protocol) if protocol.plain and protocol.stop_or_none else b""
        self._tries = 5 if self._stops else 1  # an opened Arduino resets, and boots for seconds
        self._addresses: set[int] = set()
        self._heard: set[int | None] = set()

    def note(self, address: int | None) -> None:
        """Take note of a device that was spoken to, and may have to be brought to rest."""
        if address is not None:
            self._addresses.add(address)

    def frames(self) -> tuple[bytes, ...]:
        """What is sent for that, one frame after the other."""
        if self._stops:
            return (self._stops,)
        addresses: list[dict[str, int]] = [{}]
        if self._part is not None:
            addresses = [{self._part.name: address} for address in sorted(self._addresses)]
        return tuple(
            build(self._protocol, name, {**fields, **address})
            for address in addresses
            for name, fields in self._protocol.rest_requests
        )

    def halt(self, port: Port) -> None:
        """Send that as far as the line allows, and wait for nothing."""
        with suppress(LinkError):
            port.write(b"".join(self.frames()))

    def after(self, state: State) -> State:
        """The state of a device after that."""
        for name, fields in self._protocol.rest_requests:
            state = self._protocol.by_name[name].effect.apply(state, fields)
        return state

    def patiently(self, given_up: Callable[[], bool] = lambda: False) -> Procedure[bool]:
        """Bring it to rest in a limited number of tries; return whether it answered.

        `given_up` is called after each try without an answer; if it returns true, no more are made.
        """
        for _ in range(self._tries):
            if (yield from self.once()):
                return True
            if given_up():
                break
        return False

    def once(self) -> Procedure[bool]:
        """Bring it to rest once; returns whether it was answered.

        At an address at which nobody has answered yet, nobody needs to, as long as others do.
        """
        if self._stops:
            return (yield from home_once(self._protocol))
        timing, frames = self._protocol.timing, self.frames()
        pause = round(timing.truncation_timeout * MS)
        yield from listen(None, pause if frames else 0)  # an answer under way is none to these
        due: set[int | None] = set()
        silent: set[int | None] = set()
        failed: Ended | None = None
        for frame in frames:
            asked = judge(self._protocol, frame)
            patience = round(timing.answer_longest * MS)
            try:
                heard = yield from exchange(self._protocol, asked, patience, pause)
            except Ended as error:  # the others are sent all the same
                failed = error
                continue
            if asked.answer_due:
                due.add(asked.address)
                (self._heard if heard else silent).add(asked.address)
        if failed:
            raise failed
        return silent.isdisjoint(self._heard) and (not due or silent != due)
