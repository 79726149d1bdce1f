"""Exports a capture as pcapng for Wireshark: a packet for each frame, answer and line event.

The link type is RTAC serial (250): twelve bytes of time and event before the bytes
(https://www.tcpdump.org/linktypes/LINKTYPE_RTAC_SERIAL.html). The interfaces are the two taps. All
bytes of the capture are in it, in order, and its events tell what decoding knows of them:

- `DATA_TX_START` with bytes is one frame of the host, stamped with the time of its last byte; where
  the frame was cut short, an empty `DATA_TX_END` stands where that was known.
- `DATA_TX_END` with bytes is garbage: host bytes that belong to no frame.
- `DATA_RX_START` is the device's answer to an instruction in the file; `DATA_RX_END` is one that
  answers none.
- The other events are those of the line. What has no event of its own is a `STATUS_CHANGE`.

A comment on the packet says what the event does not. What can be told from the bytes (judgements,
missing answers) is left to the dissector that `bilprov spec emit wireshark` writes.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import repeat
from operator import itemgetter
from typing import BinaryIO, NamedTuple

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, LineRecord
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.export.rows import Chosen
from bilprov.analyzer.replay import capture_decoding as decoding
from bilprov.analyzer.version import kit_version
from bilprov.captures.reader import Capture
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol

LINKTYPE_RTAC_SERIAL = 250


# The serial event types of the link type.
_STATUS_CHANGE, _TX_START, _RX_START, _TX_END, _RX_END = range(5)
_LINE_EVENTS = {
    "gap": 5,  # CAPTURE_DATA_LOST
    "reconnected": 5,
    "close": 6,  # CAPTURE_COMPLETE
    "framing": 7,
    "parity": 8,
    "break": 9,
    "overrun": 10,
}
_TAPS = ("host", "device")  # the interfaces, in order

_ELSEWHERE = "the instruction that it answers is not in this file"


class Packet(NamedTuple):
    """A packet: its time (ns since the capture's start), interface, event, bytes and comment."""

    t: int
    interface: int
    event: int
    data: bytes = b""
    comment: str = ""


def write_pcapng(chosen: Chosen, stream: BinaryIO) -> None:
    """Write a capture's chosen traffic to `stream` as pcapng, in the order of time.

    An instruction that passes the filter brings its answer, so that a reader can pair them. Raises
    OSError if the stream cannot be written, CaptureError if the capture cannot be read.
    """
    capture, protocol = chosen.capture, chosen.protocol
    stream.write(_section(capture, protocol))
    for tap in _TAPS:
        stream.write(_interface(capture, protocol, tap))
    for packets in _packets(chosen):
        stream.write(b"".join(_block(packet, capture.start + packet.t) for packet in packets))


def _packets(chosen: Chosen) -> Iterator[Sequence[Packet]]:
    """Yield the packets of the rows that are chosen, in the order of time.

    A frame is decoded when it is known to be over, an answer when it is known what it answers: so
    packets wait until nothing that is older can follow.
    """
    decoder = decoding.capture_decoder(chosen.capture, chosen.protocol)
    # Chosen instructions whose answers may follow; bounded, since a device may never answer.
    asked: deque[int] = deque(maxlen=1 << 18)
    waiting: list[Packet] = []
    read = chosen.capture.batches()
    for events in decoding.event_batches(read, chosen.progress, chosen.window, decoding.TEXT_BATCH):
        waiting += _made(decoder.decode(events), chosen, asked)
        state = decoder.saved()
        if state:  # else frame boundaries are looked for among bytes that may be old
            until = min([int(events.t[-1]), *(t for t, _ in state.held)])
            if state.frame:
                until = min(until, state.frame_end)
            waiting.sort(key=itemgetter(0))  # it is stable: what comes at one time keeps its order
            settled = bisect_right(waiting, until, key=itemgetter(0))
            yield waiting[:settled]
            del waiting[:settled]
    waiting += _made(decoder.finish(), chosen, asked)
    yield sorted(waiting, key=itemgetter(0))


def _made(batches: Iterable[Batch], chosen: Chosen, asked: deque[int]) -> Iterator[Packet]:
    """Yield the packets of the rows that pass, and those of the answers that they bring."""
    paired = decoding.heard(chosen.capture) >= BOTH
    for batch in batches:
        passing: Iterable[bool] = repeat(True)
        if chosen.test is not None:
            passing = batch.in_order(chosen.test.selection(batch)).tolist()
        for record, passes in zip(batch.records(), passing, strict=False):
            if not chosen.window.has(record.t):
                continue
            if isinstance(record, DeviceRecord):
                number = record.instruction
                while asked and number is not None and asked[0] < number:
                    asked.popleft()  # answers come in order
                brought = bool(asked) and asked[0] == number
                if brought or (passes and not paired):
                    yield Packet(record.t, 1, _RX_START, record.data)
                elif passes:
                    why = record.reason if number is None else _ELSEWHERE
                    yield Packet(record.t, 1, _RX_END, record.data, why)
            elif passes and isinstance(record, HostRecord):
                if record.sequence is not None:
                    asked.append(record.sequence)
                yield from _of_host(record)
            elif passes and isinstance(record, LineRecord):
                line = record.value
                event = _LINE_EVENTS.get(line.event, _STATUS_CHANGE)
                comment = f"{line.event}: {line.detail}" if line.detail else line.event
                yield Packet(line.t, _TAPS.index(line.tap or "host"), event, b"", comment)


def _of_host(record: HostRecord) -> Iterator[Packet]:
    if record.judgement is None:
        yield Packet(record.end, 0, _TX_END, record.data, f"garbage: {record.note}")
        return
    yield Packet(record.end, 0, _TX_START, record.data)
    if record.kind == "truncated":
        yield Packet(record.known, 0, _TX_END, b"", "the frame before it was cut short")


# The format: https://ietf-opsawg-wg.github.io/draft-ietf-opsawg-pcap/draft-ietf-opsawg-pcapng.html
_SECTION, _INTERFACE, _ENHANCED_PACKET = 0x0A0D0D0A, 1, 6
_END_OF_OPTIONS, _COMMENT = 0, 1
_USER_APPLICATION = 4  # of a section
_NAME, _DESCRIPTION, _SPEED, _RESOLUTION = 2, 3, 8, 9  # of an interface
_PACKET_FRONT = struct.Struct("<5I")
_RTAC_FRONT = struct.Struct(">IIBBH")
_MOST = (1 << 64) - 1  # of 64 bits
_LONGEST = 4_000  # characters of a text that a foreign capture may make long


def _block(packet: Packet, wall: int) -> bytes:
    seconds, rest = divmod(wall, 1_000_000_000)
    front = _RTAC_FRONT.pack(seconds & 0xFFFFFFFF, rest // 1000, packet.event, 0, 0)
    data = front + packet.data
    size = len(data)
    front = _PACKET_FRONT.pack(packet.interface, wall >> 32, wall & 0xFFFFFFFF, size, size)
    options = _options((_COMMENT, _utf8(packet.comment))) if packet.comment else b""
    return _any_block(_ENHANCED_PACKET, front + _padded(data) + options)


def _section(capture: Capture, protocol: Protocol) -> bytes:
    about = f"{protocol.name} {protocol.version}, grammar sha256 {protocol.sha256}"
    ports = _ports(capture)
    if ports:
        about += "; " + ", ".join(f"{role} {name}" for role, name in ports.items())
    body = struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)  # byte order, version, length not told
    options = _options(
        (_COMMENT, about[:_LONGEST].encode()),
        (_USER_APPLICATION, f"bilprov {kit_version()}".encode()),
    )
    return _any_block(_SECTION, body + options)


def _interface(capture: Capture, protocol: Protocol, tap: str) -> bytes:
    line = decoding.capture_line(capture, protocol)
    port = _ports(capture).get(tap)
    return _any_block(
        _INTERFACE,
        struct.pack("<HHI", LINKTYPE_RTAC_SERIAL, 0, 0)  # packets are never cut
        + _options(
            (_NAME, tap.encode()),
            (_DESCRIPTION, _utf8(f"{port}, {line}" if port else str(line))),
            (_SPEED, struct.pack("<Q", line.baud & _MOST)),
            (_RESOLUTION, bytes([9])),  # 10^-9 s
        ),
    )


def _ports(capture: Capture) -> dict[str, str]:
    """The names of the recorded ports by their role."""
    metadata = sorted(capture.metadata.items())
    return {key.removeprefix("port_"): name for key, name in metadata if key.startswith("port_")}


def _any_block(kind: int, body: bytes) -> bytes:
    whole = len(body) + 12
    return struct.pack("<II", kind, whole) + body + struct.pack("<I", whole)


def _options(*options: tuple[int, bytes]) -> bytes:
    return b"".join(
        struct.pack("<HH", code, len(value)) + _padded(value)
        for code, value in (*options, (_END_OF_OPTIONS, b""))
    )


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _utf8(text: str) -> bytes:
    return printable(text).encode()
