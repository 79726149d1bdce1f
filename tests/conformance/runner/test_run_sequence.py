"""Running a sequence against the model: a mismatch is found at its burst, with its clause."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bilprov.analyzer.client.operations import Listen, Observation, Operation, Received
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.dut.simulator import Fault, React, Simulator, answers
from bilprov.conformance.dut.target import Observability
from bilprov.conformance.mutation.catalogue import find_variant
from bilprov.conformance.mutation.faults import variants
from bilprov.conformance.oracle.profile import Profile, Timers
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from tests.support.faults import answers_with, drives_on, late, reacting, sets, when
from tests.support.robots import MS, CountingLink
from tests.support.walking import (
    CLAUSE,
    INSTRUCTIONS,
    RESPONSES,
    SAFETY,
    Walked,
    at_frame,
    burst,
    hand_made,
    run_once,
)

PASS, INFORMATIONAL, NON_STRICT = Verdict.PASS, Verdict.INFORMATIONAL, Verdict.NON_STRICT
INCONCLUSIVE, FAIL = Verdict.INCONCLUSIVE, Verdict.FAIL
DRIVES = ("11 c8", "81 07", "20")


def run_over_device(
    protocol: Protocol, fault: Fault | None, case: SequenceCase, **more: Any
) -> Walked:
    return run_once(Simulator(protocol, fault), protocol, case, **more)


# -- the reference --------------------------------------------------------------------------------


# -- each axis, at its burst ----------------------------------------------------------------------

# What the device does wrong at the frame 30 or 92 00 00; the axis, the clause, words of the reason.
WRONGS = [
    ("30", answers_with(3), "answer", RESPONSES, "answered 03 TOO_MANY_DATA instead of 00 OK"),
    ("30", answers_with(77), "answer", RESPONSES, "a code that no device sends"),
    ("30", answers_with(), "answer", RESPONSES, "no answer came"),
    ("30", answers_with(0, 0), "answer", RESPONSES, "2 answers came, 1 was due"),
    ("30", late(1100), "answer", RESPONSES, "no answer came"),
    ("30", drives_on, "state", INSTRUCTIONS, "motion is forward, expected backward"),
    ("30", sets(motion=Motion.STOPPED), "state", INSTRUCTIONS, "moving is False"),
    ("30", sets(led=1), "state", INSTRUCTIONS, "led is 1, expected 7"),
    ("30", sets(speed=199), "state", INSTRUCTIONS, "speed is 199, expected 200"),
    ("30", sets(steering=-30), "state", INSTRUCTIONS, "wheels is left"),
    ("92 00 00", answers_with(0), "answer", RESPONSES, "answered 00 OK instead of 01 BAD_HEADER"),
    ("92 00 00", drives_on, "stop", SAFETY, "moving is True, expected False"),
    ("92 00 00", sets(led=1), "state", SAFETY, "led is 1, expected 7"),
    ("92 00 00", sets(speed=13), "state", SAFETY, "speed is 13, expected 200"),
]


@pytest.mark.parametrize("place", [0, 1, 5])
@pytest.mark.parametrize(("frame", "change", "axis", "clause", "words"), WRONGS)
def test_a_mismatch_is_found_at_its_burst_on_its_axis_with_its_clause(
    protocol: Protocol,
    frame: str,
    change: React,
    axis: str,
    clause: str,
    words: str,
    place: int,
) -> None:
    others = ["20"] * place
    case = hand_made(protocol, *others, frame, "60", "70", setup=DRIVES)

    found = run_over_device(protocol, at_frame(frame, change), case)

    assert (found.wrong.burst, found.wrong.name) == (place, axis)
    assert found.wrong.step.frame == bytes.fromhex(frame)
    assert found.wrong.clause == clause != CLAUSE
    assert words in found.wrong.axis.reason
    assert found.result.verdict is FAIL
    assert found.result.axes[axis] == found.wrong.axis


@pytest.mark.parametrize("place", [0, 1, 2])
def test_in_a_burst_the_frame_that_was_answered_wrongly_is_named(
    protocol: Protocol, place: int
) -> None:
    frames = ["20", "60", "70"]
    case = hand_made(protocol, "20", burst(protocol, *frames), setup=DRIVES)

    fault = Fault("x", "test", "", react=lambda d, e, r: (
        answers(r, 2) if e.pipelined * (e.judgement.frame == bytes.fromhex(frames[place])) else r
    ))  # fmt: skip
    if not place:
        fault = at_frame("20", answers_with(2))
        case = hand_made(protocol, "60", burst(protocol, *frames), setup=("11 c8", "81 07"))
    found = run_over_device(protocol, fault, case)

    assert found.wrong.burst == 1
    assert found.wrong.step.frame == bytes.fromhex(frames[place])


def test_without_looks_a_burst_is_not_looked_at(protocol: Protocol) -> None:
    quiet = hand_made(protocol, burst(protocol, "30", looks=False), "20", setup=DRIVES)
    looked = hand_made(protocol, "30", "20", setup=DRIVES)
    fault = at_frame("30", drives_on)

    assert run_over_device(protocol, fault, quiet).mismatch is None
    assert run_over_device(protocol, fault, looked).mismatch is not None


@pytest.mark.parametrize(
    "observability", [Observability(available=False), Observability(available=True, costly=True)]
)
def test_who_cannot_look_judges_answers_and_vouches_for_no_state(
    protocol: Protocol, observability: Observability
) -> None:
    case = hand_made(protocol, "30", "92 00 00", setup=DRIVES)

    unseen = run_over_device(protocol, at_frame("30", drives_on), case, observability=observability)
    heard = run_over_device(
        protocol, at_frame("92 00 00", answers_with(2)), case, observability=observability
    )

    assert unseen.link.looks == []
    assert unseen.result.axes["answer"].verdict is PASS
    assert unseen.result.axes["state"].verdict is INCONCLUSIVE
    assert "not observable" in unseen.result.axes["state"].reason
    assert heard.wrong.burst == 1


# -- answers in time ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("deadline", "delay", "verdict"),
    [
        *((100, 90, PASS), (100, 110, NON_STRICT), (100, 900, NON_STRICT), (100, 1050, FAIL)),
        *((50, 80, NON_STRICT), (200, 150, PASS), (200, 1050, FAIL), (1500, 1400, PASS)),
    ],
)
def test_an_answer_is_slow_after_the_deadline_and_wrong_after_the_longest_time(
    protocol: Protocol, deadline: int, delay: int, verdict: Verdict
) -> None:
    case = hand_made(protocol, "20", "30", "60", setup=DRIVES)
    limits = Timers().due_within(deadline * MS)

    found = run_over_device(protocol, at_frame("30", late(delay)), case, timers=limits)

    assert found.result.axes["answer"].verdict is verdict
    slow = "R-answer-deadline" if verdict is NON_STRICT else None
    assert found.result.axes["answer"].reading == slow


def test_each_answer_of_a_burst_is_timed_from_the_one_before(protocol: Protocol) -> None:
    slow = reacting(lambda d, e, r: late(80 * (d.frames % 4 + 1))(d, e, r))
    case = hand_made(protocol, burst(protocol, "20", "30", "60", "70"), setup=DRIVES)

    found = run_over_device(protocol, slow, case)

    assert found.mismatch is None
    assert found.run.profile.slowest < 1000 * MS


@pytest.mark.parametrize("after", [3, 30])
def test_a_byte_that_nobody_asked_for_is_charged_to_the_walk(
    protocol: Protocol, after: int
) -> None:
    says = at_frame("30", lambda d, e, r: replace(r, unasked=((after * MS, 0),)))
    case = hand_made(
        protocol,
        "20",
        burst(protocol, "30", idle_ms=20),
        burst(protocol, "60", idle_ms=30),
        setup=DRIVES,
    )

    found = run_over_device(protocol, says, case)

    if after < 20:
        assert (found.wrong.burst, found.wrong.name) == (1, "answer")
        assert found.wrong.axis.reading == "R-unsolicited"
        assert "came although nothing was asked" in found.wrong.axis.reason
    else:  # the next frame came before it
        assert found.mismatch is None


def test_a_byte_that_lies_there_before_a_burst_is_charged_to_it(protocol: Protocol) -> None:
    class Chatty(Simulator):
        """Says a byte 1 ms after Backward, whatever comes then."""

        def receive(self, data: bytes, now: int) -> None:
            super().receive(data, now)
            if data == b"\x30":
                self.answer(9, now + MS)

    class Waiting(CountingLink):
        """Lets 5 ms pass after each look, unheard."""

        def do(self, ask: Operation) -> int | Received | Observation:
            reply = super().do(ask)
            if isinstance(reply, Observation):
                self._link._pass(self._link._now + 5 * MS)
            return reply

    case = hand_made(protocol, "20", "30", "60", setup=DRIVES)
    found = run_once(Chatty(protocol), protocol, case, link=Waiting)

    assert (found.wrong.burst, found.wrong.axis.reading) == (2, "R-unsolicited")


def test_an_answer_too_many_that_comes_late_is_found_in_the_homing(protocol: Protocol) -> None:
    doubled = at_frame("81 05", lambda d, e, r: replace(r, answers=(*r.answers, (2 * MS, 0))))

    found = run_over_device(protocol, doubled, hand_made(protocol, "20", "81 05", setup=DRIVES))

    assert found.mismatch is None
    assert found.result.axes["answer"].verdict is FAIL
    assert "came later than the case" in found.result.axes["answer"].reason


# -- frames in pieces -----------------------------------------------------------------------------

SPLIT = ("13 01 02 03", "11 c8", "20", "41 10")


def split(protocol: Protocol, *pauses: int) -> SequenceCase:
    """Frames in one burst, with pauses at these places; then one that is waited for."""
    return hand_made(protocol, "20", burst(protocol, *SPLIT, pauses=pauses), "30", setup=DRIVES)


@pytest.mark.parametrize("pauses", [(1,), (3,), (4,), (5,), (1, 3), (1, 2, 3, 4)])
def test_a_frame_may_come_in_pieces(protocol: Protocol, pauses: tuple[int, ...]) -> None:
    assert run_over_device(protocol, None, split(protocol, *pauses)).result.verdict is PASS


@pytest.mark.parametrize("pauses", [(1,), (5,), (1, 5)])
def test_a_device_that_cuts_a_frame_at_a_short_pause_fails_at_the_burst(
    protocol: Protocol, pauses: tuple[int, ...]
) -> None:
    hasty = Fault("x", "test", "", timeout=2 * MS)

    found = run_over_device(protocol, hasty, split(protocol, *pauses))

    assert (found.wrong.burst, found.wrong.name) == (1, "answer")


def test_the_pauses_stay_below_a_short_time_out(protocol: Protocol) -> None:
    quick = Fault("x", "test", "", timeout=6 * MS)
    profile = Profile(truncation_timeout=6 * MS)

    assert (
        run_over_device(protocol, quick, split(protocol, 1, 3, 5), profile=profile).mismatch is None
    )


class Overshooting(CountingLink):
    """A line on which each pause lasts 30 ms longer than it was told."""

    def do(self, ask: Operation) -> int | Received | Observation:
        if isinstance(ask, Listen) and ask.count is None and ask.patience:
            ask = Listen(None, ask.patience + 30 * MS)
        return super().do(ask)


def test_pauses_that_came_out_too_long_are_not_held_against_the_device(
    protocol: Protocol,
) -> None:
    coarse = Fault("x", "test", "", timeout=25 * MS)

    found = run_over_device(protocol, coarse, split(protocol, 1), link=Overshooting)

    assert found.mismatch is None
    answer = found.result.axes["answer"]
    assert answer.verdict is INFORMATIONAL
    assert "pauses came out too long" in answer.reason


def at_the_header(header: int, code: int) -> Fault:
    """A device that answers the frames with this header at once, with this code."""
    silent = when(lambda event: event.judgement.frame[0] == header, answers_with())
    return reacting(silent, begins=lambda device, byte: (code,) if byte == header else ())


def test_an_answer_at_the_header_of_a_frame_that_may_be_valid_fails(protocol: Protocol) -> None:
    case = hand_made(protocol, "20", burst(protocol, "11 c8", pauses=(1,)), setup=("20",))

    found = run_over_device(protocol, at_the_header(0x11, 0), case)

    assert (found.wrong.burst, found.wrong.axis.reading) == (1, "R-answer-point")
    assert "may still be valid" in found.wrong.axis.reason


def test_a_device_answers_wrong_headers_always_at_the_header_or_never(protocol: Protocol) -> None:
    piece = burst(protocol, "13 01 02 03", pauses=(2,))
    other = burst(protocol, "92 00 00", pauses=(1,))
    case = hand_made(protocol, "20", piece, "20", other, setup=DRIVES)
    early = find_variant(protocol, "R-answer-point=header")

    assert run_over_device(protocol, None, case).mismatch is None
    assert run_over_device(protocol, early, case).mismatch is None
    found = run_over_device(protocol, at_the_header(0x92, 1), case)
    assert (found.wrong.burst, found.wrong.axis.reading) == (3, "R-answer-point")
    assert "a device keeps to one choice" in found.wrong.axis.reason


# -- frames that are cut short --------------------------------------------------------------------


def test_a_frame_that_is_cut_short_is_left_alone_until_its_time_out(protocol: Protocol) -> None:
    case = hand_made(protocol, "20", "41", "20", burst(protocol, "60", "93 00"), setup=DRIVES)

    assert run_over_device(protocol, None, case).result.verdict is PASS
    never = run_over_device(protocol, Fault("x", "test", "", timeout=None), case)
    # Silence is a legal choice, driving on is not.
    assert (never.wrong.burst, never.wrong.name) == (1, "stop")


def test_a_device_that_answers_some_cut_frames_and_others_not_fails(protocol: Protocol) -> None:
    silent = at_frame("11", answers_with())
    case = hand_made(protocol, "20", "41", "20", "11", "30", setup=DRIVES)

    found = run_over_device(protocol, silent, case)
    assert found.wrong.burst == 3
    assert found.wrong.axis.reading == "R-truncated-known"

    always = find_variant(protocol, "R-truncated-known=silent")
    profile = Profile(truncation_timeout=50 * MS)
    for point in ("R-truncated-known", "R-truncated-unused", "R-truncated-long"):
        profile.choices.record(point, "silent", "reading/x")
    legal = run_over_device(protocol, always, case, profile=profile)
    assert legal.mismatch is None
    assert legal.result.axes["answer"].verdict is NON_STRICT


# -- devices that lose or lag ---------------------------------------------------------------------


def flushing(point: str) -> Profile:
    profile = Profile(truncation_timeout=50 * MS, flushes=True)
    profile.choices.record(point, "flushed" if "drain" in point else "lost-after-fault", "x")
    return profile


@pytest.mark.parametrize(
    ("name", "point", "frame"),
    [
        ("R-drain-known=flushed", "R-drain-known", "13 01 02 03"),
        ("R-drain-unused=flushed", "R-drain-unused", "92 00 00"),
    ],
)
def test_a_device_that_flushes_is_asked_only_for_what_it_takes(
    protocol: Protocol, name: str, point: str, frame: str
) -> None:
    lossy = find_variant(protocol, name)
    case = hand_made(
        protocol, "20", burst(protocol, "60", frame, "20", "81 03"), "70", "81 02", setup=DRIVES
    )

    legal = run_over_device(protocol, lossy, case, profile=flushing(point))
    assert legal.mismatch is None
    # One that has shown that it loses nothing fails with it,
    strict = run_over_device(protocol, lossy, case)
    assert (strict.wrong.burst, strict.wrong.axis.reason) == (1, "no answer came")
    # and so does one that takes now what it has thrown away before.
    keeps = run_over_device(protocol, None, case, profile=flushing(point))
    assert keeps.wrong.burst == 1


def test_of_what_a_flushing_device_throws_away_nothing_is_expected(protocol: Protocol) -> None:
    lossy = find_variant(protocol, "R-drain-known=flushed")
    case = hand_made(protocol, burst(protocol, "21 00", "81 03"), "20", setup=DRIVES)

    found = run_over_device(protocol, lossy, case, profile=flushing("R-drain-known"))

    assert found.mismatch is None
    assert found.trial.expected.state.led == 7


def test_a_device_that_stops_late_is_judged_in_parts(protocol: Protocol) -> None:
    late = find_variant(protocol, "R-stop-latency=50-ms")
    case = hand_made(
        protocol, "92 00 00", burst(protocol, "20", "92 00 00", "60", "81 02"), setup=DRIVES
    )

    found = run_over_device(protocol, late, case)

    assert found.mismatch is None
    assert found.result.axes["stop"].verdict is NON_STRICT
    assert found.result.axes["stop"].reading == "R-stop-latency"
    assert found.trial.expected.state.motion == Motion.ROTATE_RIGHT


# -- left alone -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "change", "axis", "clause", "words"),
    [
        ("92 00 00", {"motion": Motion.FORWARD}, "stop", SAFETY, "moved again by itself"),
        ("30", {"motion": Motion.STOPPED}, "state", INSTRUCTIONS, "by itself"),
        ("30", {"led": 1}, "state", INSTRUCTIONS, "led became 1 by itself"),
    ],
)
def test_what_changes_by_itself_is_seen_while_it_is_left_alone(
    protocol: Protocol,
    frame: str,
    change: dict[str, Any],
    axis: str,
    clause: str,
    words: str,
) -> None:
    by_itself = at_frame(
        frame, lambda d, e, r: replace(r, later=((25 * MS, r.state.but(**change)),))
    )
    left = hand_made(protocol, "20", burst(protocol, frame, idle_ms=40), setup=DRIVES)
    hurried = hand_made(protocol, "20", burst(protocol, frame, idle_ms=15), "20", setup=DRIVES)

    found = run_over_device(protocol, by_itself, left)

    assert (found.wrong.burst, found.wrong.name) == (1, axis)
    assert found.wrong.clause == clause
    assert words in found.wrong.axis.reason
    assert run_over_device(protocol, by_itself, hurried).mismatch is None


# -- one choice throughout ------------------------------------------------------------------------


def test_a_device_that_shows_another_choice_than_before_fails_by_its_reading(
    protocol: Protocol,
) -> None:
    zeroes = at_frame("00", sets(speed=0))
    case = hand_made(protocol, "20", "00", "20", setup=DRIVES)
    profile = Profile(truncation_timeout=50 * MS)
    profile.choices.record("R-stop-speed", "zeroed", "reading/after-stop")

    legal = run_over_device(protocol, zeroes, case, profile=profile)
    found = run_over_device(protocol, zeroes, case)

    assert legal.mismatch is None
    assert legal.result.axes["state"].verdict is NON_STRICT
    assert legal.result.axes["state"].reading == "R-stop-speed"
    assert (found.wrong.burst, found.wrong.axis.reading) == (1, "R-stop-speed")
    assert "a device keeps to one choice" in found.wrong.axis.reason


def test_a_device_that_takes_nothing_ahead_is_led_one_frame_at_a_time(protocol: Protocol) -> None:
    variant = variants(protocol)["R-pipelining=no"]
    case = hand_made(protocol, burst(protocol, "11 C8", "81 05", looks=False), "20")

    profile = Profile(truncation_timeout=50 * MS, one_by_one=True)
    led = run_over_device(protocol, variant.fault, case, profile=profile)
    assert led.mismatch is not None
    profile.choices.allowed["pipelining"] = "no"
    led = run_over_device(protocol, variant.fault, case, profile=profile)
    assert led.mismatch is None


def test_a_burst_says_how_it_is_delivered(protocol: Protocol) -> None:
    made: list[tuple[Burst, str]] = [
        (burst(protocol, "20"), "waited"),
        (burst(protocol, "20", "30"), "pipelined"),
        (burst(protocol, "11 05", pauses=(1,)), "split"),
        (burst(protocol, "20", idle_ms=5), "left alone"),
        (burst(protocol, "20", "11"), "cut"),
    ]

    assert [one.delivery for one, _ in made] == [word for _, word in made]
    assert hand_made(protocol, made[1][0]).pipelined
    assert not hand_made(protocol, made[0][0], made[2][0]).pipelined
    assert not hand_made(protocol, burst(protocol, "20", "30", looks=False)).pipelined
