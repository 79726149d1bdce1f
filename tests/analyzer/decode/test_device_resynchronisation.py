"""Answers are found again behind bytes that are none: on a line that never pauses, too."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.decode.session import SKEW, Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import build
from bilprov.spec.protocol import Protocol, load
from tests.analyzer.decode.test_stream import same
from tests.support import ROOT
from tests.support.decoding import MS, Event, decoded, devices, hosts, kinds
from tests.support.framed_traffic import drawn_answer, drawn_request
from tests.support.grammars import TIMES

RECEIVER = (
    '''
"""A satellite receiver of the UBX kind: it sends messages by itself between its answers."""

from construct import (
    Byte, Checksum, Const, FixedSized, Int16ub, Int16ul, Int32ul, RawCopy, Struct, Switch, this,
)
from bilprov.spec.fields import (
    Clauses, Data, Fletcher, Instruction, Length, LineDefaults, Outcome, Same, Timing,
)

NAME, VERSION, DOCUMENT = "receiver", "8", "u-blox 8 Receiver Description"
INSTRUCTIONS = {
    0x0608: "CfgRate"
    / Instruction("measured" / Int16ul, "ratio" / Int16ul, "to" / Int16ul, document="CFG-RATE")
    * "Sets how often it measures.",
    0x0121: "NavTime"
    / Instruction(document="NAV-TIMEUTC", answer=Struct("week" / Int32ul, "zone" / Byte))
    * "Asks for the time.",
}
SYNC = "sync" / Const(b"\\xb5\\x62")
CHECK = "check" / Checksum(Int16ul, Fletcher(), this.covered.data)
LENGTH = "length" / Length(Int16ul)
FRAME = Struct(
    SYNC,
    "covered"
    / RawCopy(
        Struct(
            "id" / Int16ub,
            LENGTH,
            "data" / FixedSized(this.length, Switch(this.id, INSTRUCTIONS)),
        )
    ),
    CHECK,
)
REPLY = Struct(
    SYNC,
    "covered"
    / RawCopy(
        Struct("id" / Same("id", Int16ub), LENGTH, "data" / FixedSized(this.length, Data()))
    ),
    CHECK,
)
ACK = Struct(
    SYNC,
    "covered" / RawCopy(Struct("kind" / Const(b"\\5\\1\\2\\0"), "done" / Same("id", Int16ub))),
    CHECK,
)
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM, Outcome.TOO_MANY, Outcome.TOO_FEW)
'''
    + TIMES
)
RATE = bytes.fromhex("b562 0608 0600 c800 0100 0100 de6a")  # its datasheet's, 5 Hz
DONE = bytes.fromhex("b562 0501 0200 0608 163f")
TIME = bytes.fromhex("b562 0121 0500 01000000 02 2a3b")
OTHER = bytes.fromhex("b562 0107 0100 09 12 2d")


def protocol_of(name: str) -> Protocol:
    if name == "receiver":
        return load(RECEIVER, "receiver.py")
    return load_protocol(str(ROOT / "examples" / f"{name}.py") if "_" in name else name)


def asked_and_told(protocol: Protocol, random: Random, count: int) -> list[tuple[bytes, bytes]]:
    """So many requests that are answered, each with its answer."""
    pairs: list[tuple[bytes, bytes]] = []
    while len(pairs) < count:
        request = drawn_request(protocol, random)
        answer = drawn_answer(protocol, random, request)
        pairs += [(request, answer)] if answer else []
    return pairs


def damaged(random: Random, answer: bytes, how: str) -> bytes:
    at = random.randrange(len(answer))
    if how == "stray":
        return random.randbytes(random.randint(1, 4)) + answer
    if how == "lost":
        return answer[:at] + answer[at + 1 :]
    return answer[:at] + bytes([answer[at] ^ 1 << random.randrange(8)]) + answer[at + 1 :]


@pytest.mark.sample(20)
@pytest.mark.parametrize("how", ["stray", "lost", "flipped"])
@pytest.mark.parametrize("name", ["dynamixel1", "modbus-rtu", "receiver", "relay_board"])
@pytest.mark.parametrize("seed", range(4))
def test_the_answers_behind_a_damaged_one_are_those_of_their_requests(
    name: str, how: str, seed: int
) -> None:
    protocol, random = protocol_of(name), Random(f"{name} {how} {seed}")
    pairs = asked_and_told(protocol, random, 30)
    told = [
        damaged(random, answer, how) if n == 10 else answer for n, (_, answer) in enumerate(pairs)
    ]
    events: list[Event] = []
    for n, (request, _) in enumerate(pairs):  # no pause is long enough to end a frame
        events += [Chunk(n * MS, "host", request), Chunk(n * MS + MS // 2, "device", told[n])]

    records = decoded(Session(protocol), events)
    same(protocol, events, [random.choice([1, 7, 1000])])

    found = devices(records)
    assert b"".join(one.data for one in found) == b"".join(told)
    requests = {one.sequence: one.data for one in hosts(records)}
    pairs_found = [(requests.get(one.instruction), one.data) for one in found if not one.faults]
    assert pairs_found[-15:] == pairs[-15:]


def rows(events: list[Event]) -> list[tuple[str, bytes, str]]:
    protocol = protocol_of("receiver")
    same(protocol, events, [1, 7, 1000])
    return [
        ("paired" if one.instruction is not None else "alone", one.data, one.reason)
        for one in decoded(Session(protocol), events)
        if isinstance(one, DeviceRecord)
    ]


def test_a_message_that_nobody_asked_for_does_not_hide_the_answer_behind_it() -> None:
    unasked = "no instruction waits for an answer"
    for message in (TIME, OTHER):
        between = [
            Chunk(0, "host", RATE), Chunk(MS, "device", message), Chunk(2 * MS, "device", DONE),
        ]  # fmt: skip
        assert rows(between) == [("alone", message, unasked), ("paired", DONE, "")]


def test_what_is_nearly_an_answer_and_followed_by_none_is_that_to_the_request() -> None:
    wrong = DONE[:-1] + b"\0"
    silent = [Chunk(0, "host", RATE), Chunk(MS, "device", wrong), Chunk(900 * MS, "host", RATE)]

    assert rows(silent) == [("paired", wrong, "check is 16 00, right is 16 3f")]


def test_endless_noise_of_a_device_is_decoded_in_little_time() -> None:
    protocol, random = protocol_of("receiver"), Random(1)
    request = build(protocol, "NavTime")
    events: list[Event] = [Chunk(0, "host", request)]
    events += [Chunk(n * MS, "device", random.randbytes(30)) for n in range(2000)]

    records = decoded(Session(protocol), events)

    assert b"".join(one.data for one in devices(records)) == b"".join(
        one.data for one in events[1:] if isinstance(one, Chunk)
    )
    assert "unanswered" in kinds(records)


@pytest.mark.parametrize(("ahead", "skew"), [(30, SKEW), (3, 0), (SKEW // MS, SKEW), (0, 0)])
def test_what_comes_before_a_request_answers_it_only_within_the_skew(ahead: int, skew: int) -> None:
    """A sensor that sends by itself: its message is no answer to what is asked after it."""
    protocol, random = load_protocol("modbus-rtu"), Random(1)
    asked = build(protocol, "ReadCoils", {"address": 1, "start": 0, "quantity": 8})
    message, answer = (bytes.fromhex(one) for one in ("01 01 01 01 90 48", "01 01 01 00 51 88"))
    events: list[Event] = []
    for turn in range(30):
        t = turn * 1000 * MS
        unasked = random.random() < 0.5
        events += [Chunk(t, "device", message)] * unasked
        events.append(Chunk(t + ahead * MS, "host", asked))
        events += [Chunk(t + (ahead + 2) * MS, "device", answer)] * (
            not unasked or ahead * MS > skew
        )

    same(protocol, events, [1000, 1, 7], skew=skew)
    given = devices(decoded(Session(protocol, skew=skew), events))

    if ahead * MS > skew:
        assert {one.data for one in given if one.instruction is None} == {message}
    else:
        assert all(one.instruction is not None for one in given)
    assert sum(one.instruction is not None for one in given) == 30
