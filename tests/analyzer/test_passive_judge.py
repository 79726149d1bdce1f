"""Passive judging of ordinary traffic: what it covers, and what contradicts the document."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path

import pytest

from bilprov.analyzer.decode.session import BOTH, Session
from bilprov.analyzer.monitor.passive_judge import KEPT, MOVING, Findings, PassiveJudge
from bilprov.analyzer.transport.port import open_port
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Direction, Line, Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.cases.single_frames import all_cases
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.mutation.catalogue import find_variant
from bilprov.conformance.mutation.faults import fault_bank, variants
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.readings import other_choices
from bilprov.spec.replies import build_reply, read_reply
from tests.support import ROOT
from tests.support.commands import running
from tests.support.decoding import capture_session
from tests.support.framed_traffic import FRAMED
from tests.support.recordings import recorded
from tests.support.robots import MS, RecordingRobot, served_here

Event = Chunk | Line | Look
DOCUMENT = load((ROOT / "spec" / "grammar.py").read_text(encoding="utf-8"))
SOME = ("bad-data/LED/1*", "unused-id/*/[0-2]", "wrong-length/*/[0-2]", "valid/LED/*")
MORE = ("recovery/*", "truncated/*/0", "valid/*/25*")


def host(ms: float, data: str) -> Chunk:
    return Chunk(round(ms * MS), "host", bytes.fromhex(data))


def device(ms: float, data: str) -> Chunk:
    return Chunk(round(ms * MS), "device", bytes.fromhex(data))


def seen(ms: float, moving: bool | None) -> Look:
    return CarLook(round(ms * MS), moving)


def judged(
    protocol: Protocol,
    events: Iterable[Event],
    *,
    session: Session | None = None,
    heard: frozenset[Direction] = BOTH,
    attached: bool = False,
    end: float | None = None,
) -> Findings:
    """What is found in these events, decoded as a bridge would; until `end` in ms."""
    session = session or Session(protocol, heard=heard, skew=0, attached=attached)
    passive = PassiveJudge(protocol, paired=heard >= BOTH, attached=attached)
    for event in events:
        if isinstance(event, Look):
            for record in session.advance(event.t):
                passive.record(record)
            passive.look(event)
            continue
        passive.event(event)
        for record in session.feed(event):
            passive.record(record)
    for record in session.finish(None if end is None else round(end * MS)):
        passive.record(record)
    return passive.finish()


def of_capture(path: Path, protocol: Protocol) -> Findings:
    capture = open_capture(path)
    session = capture_session(capture, protocol)
    return judged(protocol, capture.sights(), session=session)


class Overheard(RunListener):
    """Keeps what goes over a line and what its probe tells, as a capture would, in memory."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def sent(self, data: bytes, t: int) -> None:
        self.events.append(Chunk(t, "host", data))

    def received(self, data: bytes, t: int) -> None:
        self.events.append(Chunk(t, "device", data))

    def looked(self, look: Look) -> None:
        self.events.append(look)


def of_run(protocol: Protocol, device: Simulator, *only: str) -> Findings:
    """What is found while these cases are run on a device."""
    line = Overheard()
    run_suite(device_target(protocol, device), Options(only=only), [line], logged=False)
    return judged(protocol, line.events)


def counts(findings: Findings) -> dict[str, tuple[int, int]]:
    return {row.what: (row.done, row.of) for row in findings.coverage}


# -- one judge ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("grammar", ["protocol", "horn"])
def test_the_suite_and_the_passive_judge_accept_the_same_answers(
    grammar: str, request: pytest.FixtureRequest
) -> None:
    protocol: Protocol = request.getfixturevalue(grammar)
    cases = all_cases(protocol, 1, every_cut=True)
    for case in cases:
        judgement = judge(protocol, case.frame)
        others = {
            (choice.codes[0] if choice.codes else None, choice.reading, choice.word)
            for choice in case.accepted[1:]
        }
        assert case.accepted[0].codes == (judgement.response.code,), case.id
        assert others == set(other_choices(protocol, judgement)), case.id
    assert len(cases) > 3000


# -- coverage -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "only"), [("", SOME), ("no-stop-on-bad-data", ("bad-data/LED/1?", "valid/LED/*"))]
)
def test_a_run_and_its_recording_are_judged_alike(
    fault: str, only: tuple[str, ...], tmp_path: Path, protocol: Protocol
) -> None:
    def device() -> Simulator:
        return Simulator(protocol, BANK[fault] if fault else None)

    recorded(tmp_path / "run.mcap", protocol, *only, device=device())

    assert of_capture(tmp_path / "run.mcap", protocol) == of_run(protocol, device(), *only)


@pytest.mark.slow
def test_a_whole_suite_covers_all_that_it_drives(
    tmp_path: Path, protocol: Protocol, pytestconfig: pytest.Config
) -> None:
    whole = pytestconfig.getoption("--whole")
    valid = "valid/*" if whole else "valid/LED/*"
    recorded(tmp_path / "run.mcap", protocol, valid, "bad-data/*", "unused-id/*")
    findings = of_capture(tmp_path / "run.mcap", protocol)

    for what in ("data out of range", "headers with an unused ID", *["valid frames"] * whole):
        done, of = counts(findings)[what]
        assert done == of
    assert findings.violations == findings.not_judged == findings.readings == {}
    assert findings.looks > 300


@pytest.mark.slow
def test_another_grammar_is_judged_by_itself(
    tmp_path: Path, protocol: Protocol, horn: Protocol
) -> None:
    path = tmp_path / "run.mcap"
    recorded(path, horn, "valid/Horn/*", "bad-data/Horn/*", device=Simulator(horn))

    findings = of_capture(path, horn)
    assert findings.violations == {}
    assert counts(findings)["data of Horn"] == (4, 4)
    assert of_capture(path, protocol).violations["disagreeing"] > 200


# -- violations -----------------------------------------------------------------------------------


def test_only_the_first_violations_are_listed_and_all_are_counted(protocol: Protocol) -> None:
    events: list[Event] = []
    for number in range(50):
        events += [host(number * 200, "20"), device(number * 200 + 1, "09")]
    findings = judged(protocol, events)

    assert findings.violations == {"unused code": 50}
    assert [v.instruction for v in findings.listed] == list(range(KEPT))


# Losing, or cutting, what is sent ahead shifts the answers that follow; the suite's own probes send
# ahead, and a banner comes again when it switches the robot off. See the README's limits.
SHIFTING = (
    "R-drain",
    "R-pipelining=lost",
    "R-pipelining=flushed",
    "R-truncation-timeout=whole",
    "R-unsolicited=banner",
)


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in variants(DOCUMENT) if not n.startswith(SHIFTING)])
def test_no_legal_variant_is_accused(name: str, protocol: Protocol) -> None:
    variant = Simulator(protocol, find_variant(protocol, name))
    violations = of_run(protocol, variant, *SOME, "recovery/*").violations

    # What the suite accepts only with --allow, and running drained bytes, are violations here too.
    fails = bool(variants(protocol)[name].row.allow) or name == "R-drain-unused=run"
    assert bool(violations) == fails, violations


BANK = fault_bank(DOCUMENT)
# What shows only against a predicted state, not as an answer or as a stop that is missing.
STATE_ONLY = (
    "-does-nothing",
    "no-faster-",
    "-swapped",
    "led-",
    "speed-",
    "fault-changes",
    "never-moves",
)
OTHERS = ("stays-dead-after-fault", "moves-at-power-on", "bad-data-shown", "steering-starts-it")


# Of the other families most need frames in a row, which these recordings do not hold.
SHOWN_BY_ONE_FRAME = ("answer", "stop", "parsing", "motion", "setting", "line")


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, f in BANK.items() if f.family in SHOWN_BY_ONE_FRAME])
def test_a_faulty_device_is_found_by_its_answers_and_its_stops(
    name: str, protocol: Protocol
) -> None:
    findings = of_run(protocol, Simulator(protocol, BANK[name]), *SOME, *MORE)

    state_only = any(part in name for part in STATE_ONLY) and name != "nibbles-swapped"
    if not (state_only or name in OTHERS):
        assert findings.exit == 1


# -- looks ----------------------------------------------------------------------------------------

DRIVING = [host(0, "11 50"), device(1, "00"), host(200, "20"), device(201, "00"), seen(250, True)]
FAULT = [*DRIVING, host(400, "90"), device(401, "01")]
LOOKS: dict[str, tuple[list[Event], int, int]] = {
    "stopped": ([*FAULT, seen(410, False)], 1, 0),
    "still moving when it may still stop": ([*FAULT, seen(490, True)], 0, 0),
    "still moving later": ([*FAULT, seen(502, True)], 1, 1),
    "moving again by itself": ([*FAULT, seen(410, False), seen(420, True)], 2, 1),
    "one fault is accused once": ([*FAULT, seen(502, True), seen(510, True)], 1, 1),
    "moving by a setting": ([*FAULT, host(600, "11 60"), device(601, "00"), seen(650, True)], 1, 1),
    "moving by a motion": ([*FAULT, host(600, "20"), device(601, "00"), seen(650, True)], 0, 0),
    "while a motion is under way": ([*FAULT, host(600, "20"), seen(601, True)], 0, 0),
    "no fault": ([*DRIVING, seen(300, True)], 0, 0),
    "after a loss": ([*FAULT, Line(500 * MS, "gap"), seen(650, True)], 0, 0),
    "the probe does not know": ([*FAULT, seen(650, None)], 0, 0),
}


@pytest.mark.parametrize("name", LOOKS)
def test_a_robot_seen_moving_after_a_fault_is_a_violation(name: str, protocol: Protocol) -> None:
    events, looks, violations = LOOKS[name]
    findings = judged(protocol, events)

    assert (findings.looks, findings.violations.get(MOVING, 0)) == (looks, violations)
    if violations:
        assert (findings.listed[0].clause, findings.listed[0].instruction) == ("section 2", 2)
    if name == "the probe does not know":
        assert sum(findings.not_judged.values()) == 1


# -- what cannot be judged ------------------------------------------------------------------------


def traffic(protocol: Protocol, seed: int, pause: float) -> list[Event]:
    """Ordinary driving of a conforming device, faults among it; pauses in ms."""
    draw, device_, now = random.Random(seed), Simulator(protocol), 0
    frames = [bytes.fromhex(text) for text in ("1150", "20", "30", "4180", "00", "8105", "90")]
    frames += [bytes.fromhex(text) for text in ("8109", "10", "120000", "9211ff", "60", "70")]
    events: list[Event] = []
    for _ in range(60):
        frame = draw.choice(frames)
        events.append(Chunk(now, "host", frame))
        device_.receive(frame, now)
        now += round(draw.uniform(0.3, 3) * MS)
        events.append(Chunk(now, "device", device_.advance(now)))
        now += round(draw.uniform(0.3, pause) * MS)
    return events


@pytest.mark.sample(4)
@pytest.mark.parametrize("pause", [1, 20, 300])
@pytest.mark.parametrize("seed", range(3))
def test_attached_anywhere_a_conforming_device_is_never_accused(
    protocol: Protocol, seed: int, pause: float
) -> None:
    events = traffic(protocol, seed, pause)
    assert judged(protocol, events).violations == {}
    for start in range(len(events) - 10):
        first = events[start]
        rest: list[Event] = [
            Chunk(e.t - first.t + MS, e.direction, e.data)
            for e in events[start:]
            if isinstance(e, Chunk)
        ]
        assert isinstance(first, Chunk)
        for cut in range(len(first.data)):
            tail = Chunk(MS, first.direction, first.data[cut:])
            findings = judged(protocol, [tail, *rest[1:]], attached=True)
            assert findings.violations == {}, (start, cut, findings.listed)


# -- the commands ---------------------------------------------------------------------------------


@pytest.mark.waits
@pytest.mark.parametrize("wrong", [{}, {b"\x81\x09": 0}])
def test_sniff_judges_what_passes_a_bridge(protocol: Protocol, wrong: dict[bytes, int]) -> None:
    robot = RecordingRobot(protocol, wrong)
    with (
        served_here(robot, pty=True) as (port, _),
        running("sniff", "--bridge", port, "--judge", "--format", "lines") as sniffing,
        open_port(sniffing.stderr.readline().decode().strip()) as host,
    ):
        host.write(b"\x11\xff\x20\x81\x09")
        for _ in range(6):
            while b"waited" in sniffing.stdout.readline():
                pass  # where the machine is busy
        code, _, err = sniffing.end()

    assert code == bool(wrong)
    last = err.decode().splitlines()[-1]
    assert last == ("1 violation: 1 disagreeing" if wrong else "no violation was seen")


def test_an_answer_that_nobody_asked_for_is_not_told_a_right_address() -> None:
    protocol = load(FRAMED["relay_board"])
    stray = build_reply(protocol, judge(protocol, build(protocol, "On", {"address": 2})))
    assert read_reply(protocol, stray, None).reason == "the bytes are not an answer"
