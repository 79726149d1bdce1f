"""A simulated device of any grammar: bytes and times in, answers out. No port, no clock.

It conforms: it answers what is due, changes its state by the effects, and remembers what was
written to it where the grammar declares a Memory. The robot car has a simulator of its own, which
can misbehave.

Requests to it are drawn by a seed: for simulated traffic, and for tests.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from copy import deepcopy
from random import Random
from typing import Any

import msgspec

from bilprov.captures.schemas import MS
from bilprov.spec.codec import FRAMING_FAULTS, Judgement, judge
from bilprov.spec.data import FieldSpec
from bilprov.spec.fields import Memory
from bilprov.spec.framing import Framed, Framer
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.replies import build_reply


class _Device:
    """What the device at one address knows: its state, and its cells.

    A cell that was never written has its value at power-on.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.state = protocol.power_on
        self._on_fault = protocol.on_fault
        used = [one for spec in protocol.instructions for one in (spec.writes, spec.reads) if one]
        self._power_on = {memory.name: memory.power_on for memory in used if memory.power_on}
        self._resets = {(memory.reset, memory.name) for memory in used}
        self._refused = {memory.until: memory.code for memory in used}
        self._cells: dict[tuple[str, Any], dict[int, int]] = {}
        self._latest: dict[str, Any] = {}  # the value of each field in the latest request with one
        # What is written by the next instruction of that name.
        self._waiting: dict[str, tuple[Memory, Mapping[str, Any]]] = {}

    def do(self, judgement: Judgement, fields: Mapping[str, Any]) -> str:
        """Do what a frame asks for, whose fields for this device are these.

        Returns the name of the answer to one that cannot be done, "" for one that is.
        """
        spec = judgement.instruction
        if not judgement.valid or spec is None:
            self.state = self._on_fault.apply(self.state)
            return ""
        self._latest |= fields
        if spec.name in self._waiting:
            self._write(*self._waiting.pop(spec.name))
        elif self._refused.get(spec.name):
            return self._refused[spec.name]
        for reset, name in self._resets:
            if reset == spec.name:
                self._cells = {key: held for key, held in self._cells.items() if key[0] != name}
                self._waiting = {u: one for u, one in self._waiting.items() if one[0].name != name}
        if spec.writes and spec.writes.until:
            self._waiting[spec.writes.until] = spec.writes, fields
        elif spec.writes:
            self._write(spec.writes, fields)
        self.state = spec.effect.apply(self.state, dict(fields))
        return ""

    def read(self, memory: Memory, fields: Mapping[str, Any], told: FieldSpec) -> Any:
        """The value of the field `told` of the answer, in which a request's cells are."""
        first, cells = self._place(memory, fields)
        fixed = told.many.fixed if told.many else 1
        count = fields[memory.count] if memory.count else fixed
        values = [cells.get(place, 0) for place in range(first, first + count)]
        if told.many is None:
            return values[0]
        if memory.bits:  # the first bit of each byte is its bit 0
            groups = (values[at : at + 8] for at in range(0, len(values), 8))
            values = [sum(bit << place for place, bit in enumerate(group)) for group in groups]
        return bytes(values) if told.many.element is None else tuple(values)

    def _write(self, memory: Memory, fields: Mapping[str, Any]) -> None:
        first, cells = self._place(memory, fields)
        keep, written = fields[memory.keep] if memory.keep else 0, fields[memory.value]
        if isinstance(written, int):
            values = [int(written != 0) if memory.bits else written]
        elif memory.bits:
            values = [byte >> bit & 1 for byte in written for bit in range(8)]
        else:
            values = [*written]
        for at, value in enumerate(values[: fields.get(memory.count, len(values))], first):
            cells[at] = cells.get(at, 0) & keep | value & ~keep

    def _place(self, memory: Memory, fields: Mapping[str, Any]) -> tuple[int, dict[int, int]]:
        """The number of the first cell that is meant, and the cells that it is one of."""
        first = memory.cell(fields.get(memory.at, self._latest.get(memory.at, 0)))
        of = fields[memory.of] if memory.of else None
        known = dict(self._power_on.get(memory.name, {}))
        return first, self._cells.setdefault((memory.name, of), known)


class SimulatedDevice:
    """The devices at all addresses of a line, each of which conforms. Times are integers in ns.

    Where frames have no address there is one device.
    What is sent to all is done by every device, and answered by none.
    """

    lossless = True

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.power_cycle(0)

    def power_cycle(self, now: int) -> None:
        """Switch the devices off and on: they forget everything."""
        timeout = int(self.protocol.timing.truncation_timeout * MS)
        self._framer = Framer(self.protocol, timeout)
        # A device that nobody has addressed yet.
        self._untold = _Device(self.protocol)
        self._devices: dict[int | None, _Device] = {}
        self._answers: deque[tuple[int, bytes]] = deque()

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host that arrive at `now`."""
        self._take(self._framer.feed(data, now))

    def advance(self, now: int) -> bytes:
        """Let time pass until `now`; return the bytes that were sent until then."""
        self._take(self._framer.advance(now))
        due = bytearray()
        while self._answers and self._answers[0][0] <= now:
            due += self._answers.popleft()[1]
        return bytes(due)

    def deadline(self) -> int | None:
        """When (ns) a device next acts by itself, None if they only wait for bytes."""
        times = [self._framer.deadline, self._answers[0][0] if self._answers else None]
        return min((at for at in times if at is not None), default=None)

    def probe(self, now: int) -> bytes:
        """The state of each addressed device at `now` as a line of JSON without newline."""
        states = {str(address): one.state for address, one in self._devices.items()}
        return msgspec.json.encode(states)

    def state(self, address: int | None = None) -> Any:
        """The state of the device at an address; None where frames have no address."""
        return self._devices.get(address, self._untold).state

    def _take(self, records: Iterable[Framed]) -> None:
        for record in records:
            if record.kind != "garbage":
                self._handle(judge(self.protocol, record.data), record.known)

    def _handle(self, judgement: Judgement, known: int) -> None:
        if judgement.outcome in FRAMING_FAULTS:  # whom such a frame is for is not known
            self._answer(judgement, {}, known)
            return
        refusals = [device.do(judgement, fields) for device, fields in self._meant(judgement)]
        if judgement.answer_due and (refusal := "".join(refusals)):
            named = {one.name: one for one in self.protocol.responses}
            judgement = msgspec.structs.replace(judgement, response=named[refusal])
        values = self._told(judgement) if judgement.valid and judgement.answer_due else {}
        self._answer(judgement, values, known)

    def _answer(self, judgement: Judgement, values: dict[str, Any], known: int) -> None:
        try:
            answer = build_reply(self.protocol, judgement, values)
        except OverflowError:  # more is asked for than the length of an answer can count
            return
        if answer:
            self._answers.append((known, answer))

    def _meant(self, judgement: Judgement) -> Iterator[tuple[_Device, dict[str, Any]]]:
        """The devices that a frame is for, and the fields for each; those unaddressed are one."""
        part = self.protocol.layout.part("address")
        spec, fields = judgement.instruction, dict(judgement.fields)
        parts = [(judgement.address, fields)]
        if judgement.valid and spec and spec.writes and spec.writes.blocks:
            memory = spec.writes
            value, size = fields[memory.value], 1 + fields[memory.count]
            parts = [
                (value[at], {**fields, memory.value: value[at + 1 : at + size]})
                for at in range(0, len(value), size)
            ]
        elif part is not None and judgement.address == part.broadcast:
            yield from ((device, fields) for device in (self._untold, *self._devices.values()))
            return
        for address, its_fields in parts:
            if part is None or address is None or part.low <= address <= part.high:
                yield self._device(address), its_fields

    def _device(self, address: int | None) -> _Device:
        if address not in self._devices:
            self._devices[address] = deepcopy(self._untold)
        return self._devices[address]

    def _told(self, judgement: Judgement) -> dict[str, Any]:
        """The values of an answer's fields that the device knows."""
        spec, told = judgement.instruction, dict[str, Any]()
        if spec is None or spec.answer is None:
            return told
        device = self._device(judgement.address)
        for part in spec.answer.fields:
            state = getattr(device.state, part.reports.variable) if part.reports else None
            if part.reports and state is not None:
                told[part.name] = part.reports.value(state, part.names)
            elif spec.reads and part.name == spec.reads.value:
                told[part.name] = device.read(spec.reads, dict(judgement.fields), part)
        return told


_ADDRESSES = 3  # devices that are spoken to
_MOST = 8  # elements of a field that nothing counts
_LONGEST = 240  # bytes of data


def drawn_request(protocol: Protocol, chance: Random) -> bytes:
    """A valid request to one of a few devices; small numbers are likelier than large ones."""
    spec = chance.choice(protocol.instructions)
    layout = protocol.layout
    parts = {"id": spec.id}
    for part in layout.parts:
        if part.role == "address":
            parts[part.name] = chance.randint(part.low, min(part.high, part.low + _ADDRESSES - 1))
    while True:  # what the length of a frame cannot count is drawn again
        data = _data(spec, chance)
        with suppress(OverflowError):
            if len(data) <= _LONGEST:
                return layout.build(parts, data)


def faulty_request(protocol: Protocol, chance: Random) -> bytes:
    """A request with a wrong bit in its last byte, where that is its check or a constant.

    Where a header byte is all that stands around the data, any header and data that are not valid.
    """
    while protocol.plain:
        header = chance.randrange(len(protocol.headers))
        frame = bytes([header]) + chance.randbytes(protocol.lengths[header])
        if not judge(protocol, frame).valid:
            return frame
    frame = drawn_request(protocol, chance)
    layout = protocol.layout.of_frame(frame)
    last = layout.parts[-1] if layout.tail else None
    if last is None or last.role not in ("check", "constant"):
        return frame
    return frame[:-1] + bytes([frame[-1] ^ 1 << chance.randrange(8)])


def _data(spec: InstructionSpec, chance: Random) -> bytes:
    built, numbers = b"", dict[str, int]()
    for part in spec.fields:
        if part.constant is not None:
            built += part.constant
        elif part.many is not None:
            built += part.build(_elements(spec, part, built, numbers, chance))
        else:
            numbers[part.name] = _number(part, chance)
            built += part.build(numbers[part.name])
    return built


def _number(part: FieldSpec, chance: Random) -> int:
    if part.names:
        return chance.choice(part.names)[1]
    if part.flags:
        return sum(mask for _, mask in part.flags if chance.random() < 0.5)
    return part.low + int(part.count ** chance.random()) - 1


def _elements(
    spec: InstructionSpec, part: FieldSpec, before: bytes, numbers: dict[str, int], chance: Random
) -> bytes | tuple[int, ...]:
    """The value of a field of bytes or of several numbers, as many as the others ask for."""
    many = part.many
    assert many is not None
    count = chance.randint(1, _MOST)
    if many.how == "fixed":
        count = many.fixed
    elif many.how == "expression":
        count = ((spec.measure(before) or len(before)) - len(before)) // many.width
    elif spec.writes and spec.writes.value == part.name and spec.writes.count in numbers:
        count = numbers[spec.writes.count]
        count = -(-count // 8) if spec.writes.bits else count
    if many.element is None:
        return chance.randbytes(count)
    if part.unlimited:
        return tuple(chance.randint(part.low, part.high) for _ in range(count))
    return tuple(_number(part, chance) for _ in range(count))
