"""State model: the hand-typed sequences, and what each other choice changes."""

from __future__ import annotations

import pytest

from bilprov.conformance.cases.steps import step_of
from bilprov.conformance.oracle.profile import Choices
from bilprov.conformance.oracle.state_model import ExpectedState
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, STATE_POINTS
from tests.support.car import car_state, frame_effect, model_of
from tests.vectors import SEQUENCES, RobotState, Sequence

DRIVING = car_state(Motion.FORWARD, speed=200, steering=40, led=5)
TURNING = DRIVING.but(motion=Motion.ROTATE_LEFT)


# -- by default -----------------------------------------------------------------------------------


@pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda s: f"{s.clause}: {s.title}")
def test_by_default_the_model_does_what_the_document_says(
    protocol: Protocol, sequence: Sequence
) -> None:
    model, expected_state = model_of(protocol), ExpectedState(protocol.power_on)

    for typed in sequence.steps:
        step = step_of(protocol, typed.frame)
        expected_state = model.after(expected_state, step.frame_effect)
        state = expected_state.state
        seen = RobotState(str(state.motion), state.speed, state.steering, state.led, state.moving)
        assert (step.accepted[0].codes, seen) == ((typed.code,), typed.state)
        assert (expected_state.unknown, expected_state.pending_speed, expected_state.rests_on) == (
            frozenset(),
            None,
            frozenset(),
        )


def test_a_choice_that_is_the_default_changes_nothing(protocol: Protocol) -> None:
    reference = model_of(protocol)
    defaults = model_of(protocol, {point: POINTS[point].default for point in STATE_POINTS})

    for sequence in SEQUENCES:
        told = known = ExpectedState(protocol.power_on)
        for typed in sequence.steps:
            effect = step_of(protocol, typed.frame).frame_effect
            told, known = defaults.after(told, effect), reference.after(known, effect)
            assert told == known


# -- each other choice ----------------------------------------------------------------------------


def test_a_later_speed_replaces_the_one_that_waits(protocol: Protocol) -> None:
    model = model_of(protocol, {"R-speed-moving": "next-motion"})
    waits = model.after(ExpectedState(DRIVING), frame_effect(protocol, "Speed", 90))

    later = model.after(waits, frame_effect(protocol, "Speed", 91))
    assert (later.pending_speed, later.state.speed) == (91, 200)

    rested = model.after(
        model.after(waits, frame_effect(protocol, "Stop")), frame_effect(protocol, "Speed", 92)
    )
    assert (rested.pending_speed, rested.state.speed) == (None, 92)
    assert model.after(rested, frame_effect(protocol, "Forward")).state.speed == 92


@pytest.mark.parametrize("point", ["R-stop-speed", "R-fault-state speed"])
def test_a_stop_that_zeroes_the_speed_zeroes_the_one_that_waits(
    protocol: Protocol, point: str
) -> None:
    model = model_of(protocol, {"R-speed-moving": "next-motion", point: "zeroed"})
    waits = model.after(ExpectedState(DRIVING), frame_effect(protocol, "Speed", 90))

    stopped = model.after(
        waits, frame_effect(protocol, "Stop" if point == "R-stop-speed" else "fault")
    )

    assert (stopped.state.speed, stopped.pending_speed) == (0, None)
    assert model.after(stopped, frame_effect(protocol, "Forward")).state.speed == 0


def test_the_motion_is_known_again_after_the_next_one(protocol: Protocol) -> None:
    model = model_of(protocol, {"R-steer-rotating": "curve"})
    curve = model.after(ExpectedState(TURNING), frame_effect(protocol, "Right", 9))

    for name in ("Forward", "Backward", "RotateRight", "RotateLeft", "Stop", "fault"):
        assert model.after(curve, frame_effect(protocol, name)).unknown == frozenset(), name


# -- what is not known ----------------------------------------------------------------------------


def test_of_a_robot_that_was_found_nothing_is_known_but_what_is_set(protocol: Protocol) -> None:
    model = model_of(protocol)
    expected_state = model.found()

    assert expected_state.unknown == {"speed", "steering", "led"}
    assert expected_state.still
    expected_state = model.after(expected_state, frame_effect(protocol, "Speed", 7))
    assert expected_state.unknown == {"steering", "led"}
    expected_state = model.after(expected_state, frame_effect(protocol, "LED", 7))
    assert expected_state.unknown == {"steering"}
    assert model.after(expected_state, frame_effect(protocol, "Left", 7)).unknown == frozenset()
    assert model.after(expected_state, frame_effect(protocol, "Stop")).unknown == frozenset()


def test_after_homing_a_direction_is_known_and_the_settings_are_not(protocol: Protocol) -> None:
    reference = model_of(protocol)
    homed = reference.homed(reference.found())
    assert (homed.state.motion, homed.unknown) == (Motion.STOPPED, {"speed", "led"})

    keeps = model_of(protocol, {"R-stop-steering": "kept"})
    assert keeps.homed(keeps.found()).unknown == {"speed", "steering", "led"}

    zeroes = model_of(protocol, {"R-stop-speed": "zeroed", "R-led-state stop": "off"})
    homed = zeroes.homed(zeroes.found())
    assert (homed.state.speed, homed.state.led, homed.unknown) == (0, 0, frozenset())


# -- choices --------------------------------------------------------------------------------------


def test_trying_another_choice_leaves_the_devices_own_as_they_are() -> None:
    choices = Choices()
    choices.record("R-stop-speed", "zeroed", "x")

    kept = choices.but("R-stop-speed", "kept")
    more = choices.but("R-stop-steering", "kept")

    assert (choices.word("R-stop-speed"), choices.others) == ("zeroed", {"R-stop-speed"})
    assert (kept.word("R-stop-speed"), kept.others) == ("kept", set())
    assert more.others == {"R-stop-speed", "R-stop-steering"}
