"""Motion model: what the robot does after each instruction, and how its wheels turn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from bilprov.spec.motion import Motion, visible_motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import Effect, FromField
from tests.support.car import car_state, wheels
from tests.vectors import SEQUENCES, WHEELS, Sequence, WheelVector

if TYPE_CHECKING:
    from tests.conftest import Drive


@pytest.mark.parametrize("sequence", SEQUENCES, ids=lambda s: f"{s.clause}: {s.title}")
def test_the_robot_does_what_the_document_says(
    protocol: Protocol, drive: Drive, sequence: Sequence
) -> None:
    done = drive(protocol, [step.frame for step in sequence.steps])

    assert done == [(step.code, step.state) for step in sequence.steps]


@pytest.mark.parametrize("motion", Motion)
@pytest.mark.parametrize("speed", [0, 1])
def test_only_a_direction_with_a_speed_moves_and_is_seen(motion: Motion, speed: int) -> None:
    state = car_state(motion, speed)
    moves = speed > 0 and motion != Motion.STOPPED

    assert state.moving == moves
    assert visible_motion(state) == (motion if moves else Motion.STOPPED)
    assert (wheels(state, 255) != (0, 0)) == moves


def _sign(value: int) -> int:
    return (value > 0) - (value < 0)


@pytest.mark.parametrize("speed", [2, 200, 255])
@pytest.mark.parametrize("vector", WHEELS, ids=str)
def test_the_wheels_turn_as_the_motion_and_the_steering_say(
    vector: WheelVector, speed: int
) -> None:
    state = car_state(Motion(vector.motion), speed, vector.steering)
    left, right = wheels(state, 255)

    assert (_sign(left), _sign(right)) == (vector.left, vector.right)
    faster = "left" if abs(left) > abs(right) else "right" if abs(right) > abs(left) else ""
    assert faster == vector.faster


@pytest.mark.parametrize("motion", [Motion.FORWARD, Motion.BACKWARD])
@pytest.mark.parametrize(("steering", "inner"), [(255, 1), (-255, 0)])
def test_at_full_steering_the_inner_wheel_stands_still(
    motion: Motion, steering: int, inner: int
) -> None:
    turned = wheels(car_state(motion, 200, steering), 255)

    assert turned[inner] == 0
    assert abs(turned[1 - inner]) == 200


def test_a_robot_that_cannot_steer_drives_straight_on() -> None:
    assert wheels(car_state(Motion.FORWARD, 9), 0) == (9, 9)


@pytest.mark.parametrize(
    ("effect", "after"),
    [
        (Effect(), (10, 20)),
        (Effect((("speed", 7),)), (7, 20)),
        (Effect((("steering", FromField("strength", -1)),)), (10, -30)),
    ],
)
def test_an_effect_changes_only_what_it_names(effect: Effect, after: tuple[int, int]) -> None:
    before = car_state(Motion.FORWARD, 10, 20, 3)

    assert effect.apply(before, {"strength": 30}) == car_state(Motion.FORWARD, *after, 3)
