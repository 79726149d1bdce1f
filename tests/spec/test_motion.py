"""Motion model: what the robot does after each instruction, and how its wheels turn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bilprov.spec.motion import Effect, Motion, State, wheels
from bilprov.spec.protocol import Protocol
from tests.vectors import POWER_ON, SEQUENCES, WHEELS, Sequence, WheelVector

if TYPE_CHECKING:
    from tests.conftest import Drive


@pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda s: f"{s.clause}: {s.title}")
def test_the_robot_does_what_the_document_says(
    protocol: Protocol, drive: Drive, sequence: Sequence
) -> None:
    done = drive(protocol, [step.frame for step in sequence.steps])

    assert done == [(step.code, step.state) for step in sequence.steps]


def test_at_power_on_it_stands_still(protocol: Protocol) -> None:
    state = protocol.power_on

    assert (state.motion, state.speed, state.steering, state.led, state.moving) == POWER_ON


@pytest.mark.parametrize("motion", [m for m in Motion if m is not Motion.STOPPED])
def test_a_direction_with_speed_0_is_remembered_and_seen_as_stopped(motion: Motion) -> None:
    standing, driving = State(motion, speed=0), State(motion, speed=1)

    assert not standing.moving
    assert standing.visible_motion is Motion.STOPPED
    assert driving.moving
    assert driving.visible_motion is motion


def test_a_speed_without_a_direction_does_not_move() -> None:
    state = State(Motion.STOPPED, speed=255)

    assert not state.moving
    assert state.visible_motion is Motion.STOPPED
    assert wheels(state, 255) == (0, 0)


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


@pytest.mark.parametrize("speed", [2, 200, 255])
@pytest.mark.parametrize("vector", WHEELS, ids=str)
def test_the_wheels_turn_as_the_motion_and_the_steering_say(
    vector: WheelVector, speed: int
) -> None:
    state = State(Motion(vector.motion), speed, vector.steering)
    left, right = wheels(state, 255)

    assert (_sign(left), _sign(right)) == (vector.left, vector.right)
    faster = "left" if abs(left) > abs(right) else "right" if abs(right) > abs(left) else ""
    assert faster == vector.faster


@pytest.mark.parametrize("motion", [Motion.FORWARD, Motion.BACKWARD])
@pytest.mark.parametrize(("steering", "inner"), [(255, 1), (-255, 0)])
def test_at_full_steering_the_inner_wheel_stands_still(
    motion: Motion, steering: int, inner: int
) -> None:
    turned = wheels(State(motion, 200, steering), 255)

    assert turned[inner] == 0
    assert abs(turned[1 - inner]) == 200


def test_a_robot_that_cannot_steer_drives_straight_on() -> None:
    assert wheels(State(Motion.FORWARD, 9), 0) == (9, 9)


def test_an_effect_changes_only_what_it_names() -> None:
    before = State(Motion.FORWARD, 10, 20, 3)

    assert Effect().apply(before) == before
    assert Effect((("speed", 7),)).apply(before) == State(Motion.FORWARD, 7, 20, 3)


def test_an_effect_multiplies_a_field_by_its_factor() -> None:
    effect = Effect((("steering", ("strength", -1)),))

    assert effect.apply(State(), {"strength": 30}).steering == -30
