"""What the bus remembers, and what was not read in time."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from random import Random

import pytest

from bilprov.analyzer.decode.checkpoint import decoded, encoded
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.monitor.passive_judge import Findings, PassiveJudge
from bilprov.analyzer.simulated.device import SimulatedDevice
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import Protocol, load
from tests.support.framed_traffic import FRAMED, drawn_request

FRAMES = (b"\x20", b"\x11\x01", b"\x00", b"\x81\x09", b"\xf0", b"\x41\xff")
CUT = b"\x11"
PERIOD = 20 * MS
GIVEN_UP = 60 * MS  # how long the device waits for the rest of a frame
Event = Chunk | Line


def traffic(
    protocol: Protocol,
    rng: random.Random,
    answer: Callable[[int, int], int],
    count: int = 600,
    frames: Sequence[bytes] = FRAMES,
) -> list[Chunk]:
    """Frames and their answers, each at its own time."""
    events, t = [], 0
    for number in range(count):
        frame = rng.choice(frames)
        byte = answer(number, judge(protocol, frame).response.code)
        wait = GIVEN_UP if frame == CUT else 0
        events += [
            Chunk(t, "host", frame),
            Chunk(t + wait + rng.randrange(1, 9) * MS, "device", b"%c" % byte),
        ]
        t += wait + PERIOD
    return events


def read(events: list[Chunk], pauses: list[tuple[int, int]]) -> list[Event]:
    """What a reader makes of the traffic that is stopped from time to time."""
    got: list[Event] = []
    for begin, end in pauses:
        before = [event for event in events if event.t <= begin]
        meanwhile = [event for event in events if begin < event.t <= end]
        events = [event for event in events if event.t > end]
        got += before
        if meanwhile:
            got.append(Line(begin, "waited", "", "stopped"))
        for side in ("host", "device"):
            data = b"".join(event.data for event in meanwhile if event.direction == side)
            if data:
                got.append(Chunk(end, side, data))
    return got + events


def pauses_of(rng: random.Random) -> list[tuple[int, int]]:
    begins = sorted(rng.sample(range(0, 12_000, 4_000), 2))
    return [
        ((at + rng.randrange(1_000)) * MS, (at + 1_000 + rng.randrange(3_000)) * MS)
        for at in begins
    ]


def judged(protocol: Protocol, events: list[Event]) -> Findings:
    session = Session(protocol, skew=20 * MS)
    found = PassiveJudge(protocol)
    for event in events:
        found.event(event)
        for record in session.feed(event):
            found.record(record)
    for record in session.advance(events[-1].t + 3_000 * MS):
        found.record(record)
    return found.finish()


@pytest.mark.parametrize("frames", [FRAMES, (*FRAMES, CUT)], ids=["whole", "cut short"])
@pytest.mark.parametrize("seed", range(8))
def test_a_good_device_is_good_however_the_reader_was_stopped(
    protocol: Protocol, seed: int, frames: Sequence[bytes]
) -> None:
    rng = random.Random(seed)
    pauses = pauses_of(rng)
    events = read(traffic(protocol, rng, lambda _, code: code, 600, frames), pauses)
    findings = judged(protocol, events)
    assert findings.listed == []
    if CUT in frames:
        return
    assert findings.exit == 0
    assert findings.unread == sum(end - begin for begin, end in pauses)
    assert findings.judged == findings.instructions == 600
    assert not findings.readings


@pytest.mark.parametrize("seed", range(8))
def test_a_fault_outside_of_the_pauses_is_found(protocol: Protocol, seed: int) -> None:
    rng = random.Random(seed)
    pauses = pauses_of(rng)
    number = (pauses[-1][1] // PERIOD) + 100  # more than enough right answers later
    events = traffic(protocol, rng, lambda at, code: 99 if at == number else code, number + 9)
    assert judged(protocol, read(events, pauses)).exit == 1


TEXT = FRAMED["relay_board"]
RELAY = load(TEXT, "relay_board.py")
FOR_ALL = load(TEXT.replace("Address(Byte, 1, 4)", "Address(Byte, 1, 4, broadcast=0)"), "all.py")


def states(session: Session, protocol: Protocol, *sent: tuple[str, int]) -> list[int | None]:
    """Whether each addressed relay is on after its frame, as is predicted; None: not known."""
    found = []
    for place, (name, address) in enumerate(sent):
        frame = build(protocol, name, {"address": address})
        records = session.feed(Chunk(place * MS, "host", frame))
        found += [record.state.on for record in records if isinstance(record, HostRecord)]
    return found


def test_what_is_sent_to_all_changes_each_state() -> None:
    sent = (("Toggle", 1), ("On", 0), ("Read", 1), ("Read", 4), ("Off", 0), ("Read", 1))
    assert states(Session(FOR_ALL), FOR_ALL, *sent) == [1, 1, 1, 1, 0, 0]


def test_a_checkpoint_has_the_state_of_each_address() -> None:
    session, other = Session(RELAY), Session(RELAY)
    states(session, RELAY, ("On", 1), ("Pulse", 2))
    saved = session.saved()
    assert saved is not None
    again = decoded(encoded(saved), RELAY)
    assert again == saved
    other.resume(again)
    assert states(other, RELAY, ("Read", 1), ("Read", 2), ("Read", 3)) == [1, None, 0]


# -- an answer that reports a variable sets what is predicted from then on -------------------------

FAN = load(
    FRAMED["relay_board"]
    .replace("STATE = Variables(on=Whole(0, 1))", 'STATE = Variables(on=Word("off", "on"))')
    .replace(
        'Reports("on", Enum(Byte, on=1, off=2), factor=-1, plus=2)',
        'Reports("on", Enum(Byte, on=1, off=2))',
    )
    .replace("on=1))", 'on="on"))')
    .replace("on=0)", 'on="off")')
    .replace("on=Changed(-1, 1)", "on=Unknown()")
    .replace("    Whole,\n", "    Whole,\n    Word,\n")
)


@pytest.mark.parametrize("protocol", [RELAY, FAN], ids=["number", "word"])
def test_the_prediction_agrees_with_a_simulated_device_that_changed_unseen(
    protocol: Protocol,
) -> None:
    device, session, random = SimulatedDevice(protocol), Session(protocol), Random(3)
    for step in range(60):
        t, request = step * 1000 * MS, drawn_request(protocol, random)
        device.receive(request, t)
        if random.random() < 0.3:
            device.advance(t + MS)
            continue  # nobody has seen it
        session.feed(Chunk(t, "host", request))
        (record,) = session.feed(Chunk(t + MS, "device", device.advance(t + MS)))

        known = device.state(judge(protocol, request).address)
        assert known.on is None or record.state == known
