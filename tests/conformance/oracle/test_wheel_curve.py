"""A curve of the wheels: what falls fails, what is flat is non-strict, noise is neither."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.conformance.oracle.wheel_curve import (
    Kind,
    WheelCurve,
    curve_of,
    deepest_fall,
    plateaus,
    traits,
)
from bilprov.spec.motion import Motion

SPEEDS = range(256)
seeds = st.integers(0, 1 << 30)


def straight(speeds: Sequence[int], spread: int = 0) -> WheelCurve:
    """Both wheels forward with these speeds, at the settings 0, 1, ..."""
    both = tuple(speeds)
    return WheelCurve("speed", Motion.FORWARD, tuple(range(len(both))), both, both, spread)


def steered(inner: Sequence[int], side: int = 1, motion: Motion = Motion.FORWARD) -> WheelCurve:
    """The outer wheel at 255, the inner one with these speeds, at the strengths 0, 1, ..."""
    ahead = 1 if motion is Motion.FORWARD else -1
    outer = (ahead * 255,) * len(inner)
    slow = tuple(ahead * speed for speed in inner)
    settings = tuple(side * strength for strength in range(len(inner)))
    left, right = (outer, slow) if side > 0 else (slow, outer)
    return WheelCurve("steering", motion, settings, left, right)


def kinds(curve: WheelCurve, *others: WheelCurve) -> list[Kind]:
    return [trait.kind for trait in traits(curve, others)]


def noisy(law: Callable[[int], int], most: int, seed: int) -> WheelCurve:
    """Three looks at each speed, each up to `most` beside the law."""
    random = Random(seed)

    def look(speed: int) -> tuple[int, int]:
        return law(speed) + random.randint(-most, most), law(speed) + random.randint(-most, most)

    looks = [(speed, [look(speed) for _ in range(3)]) for speed in SPEEDS]
    return curve_of("speed", Motion.FORWARD, looks)


@given(st.lists(st.integers(0, 255), min_size=2, max_size=256))
def test_a_curve_that_never_falls_never_fails(speeds: list[int]) -> None:
    assert Kind.REVERSED not in kinds(straight(sorted(speeds)))


@given(st.lists(st.integers(-255, 255), min_size=2, max_size=64))
def test_the_deepest_fall_is_the_deepest_of_all_pairs(series: list[int]) -> None:
    pairs = [(a, b) for a in range(len(series)) for b in range(a + 1, len(series))]
    deepest = max(series[a] - series[b] for a, b in pairs)
    found = deepest_fall(series)

    assert (found is None) == (deepest <= 0)
    assert found is None or series[found[0]] - series[found[1]] == deepest


@given(st.integers(1, 254), st.integers(1, 255))
def test_a_fall_counts_from_5_percent_of_full_scale_on(place: int, fall: int) -> None:
    speeds = [speed - fall if speed == place else speed for speed in SPEEDS]
    counts = fall - 1 > 0.05 * 255 or fall - place > 0.05 * 255

    assert (Kind.REVERSED in kinds(straight(speeds))) == counts


@pytest.mark.parametrize(("fall", "counts"), [(3, False), (4, True)])
def test_on_a_small_scale_a_fall_counts_from_3_steps_on(fall: int, counts: bool) -> None:
    assert (Kind.REVERSED in kinds(straight([0, 5, 10, 20, 20 - fall]))) == counts


@given(seeds, st.integers(0, 60))
def test_noise_on_a_line_is_no_fall_and_no_plateau(seed: int, most: int) -> None:
    found = kinds(noisy(lambda speed: speed, most, seed))

    assert not {Kind.REVERSED, Kind.FLAT, Kind.UNRESOLVED} & set(found)


@given(seeds, st.integers(0, 20))
def test_a_signed_byte_fails_through_noise(seed: int, most: int) -> None:
    curve = noisy(lambda speed: speed - 256 * (speed > 127), most, seed)

    assert Kind.REVERSED in kinds(curve)


@given(seeds)
def test_noise_that_hides_the_whole_sweep_is_inconclusive(seed: int) -> None:
    assert kinds(noisy(lambda speed: speed // 64, 60, seed)) == [Kind.UNRESOLVED]


@given(st.integers(0, 255), st.integers(0, 255))
def test_a_plateau_is_told_with_its_bounds(one: int, other: int) -> None:
    low, high = sorted((one, other))
    speeds = [low if low <= speed <= high else speed for speed in SPEEDS]
    found = list(plateaus(tuple(SPEEDS), speeds, 0, 0.05 * 255))
    full = max(speeds)

    assert found == ([(low, high)] if (high - low) / 255 * full > 0.05 * 255 else [])


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda s: min(s, 127), "speed 127 to 255 are alike"),
        (lambda s: min(s, 200), "speed 200 to 255 are alike"),
        (lambda s: 0 if s <= 30 else s, "speed 0 to 30 is a dead zone"),
        (lambda s: 0 if s <= 30 else min(s, 200), "speed 0 to 30 is a dead zone, "),
    ],
)
def test_bounds_in_words(law: Callable[[int], int], words: str) -> None:
    (trait,) = traits(straight([law(speed) for speed in SPEEDS]))

    assert trait.kind is Kind.FLAT
    assert trait.words.startswith(words)


def test_many_plateaus_are_counted() -> None:
    (trait,) = traits(straight([speed // 32 * 32 for speed in SPEEDS]))

    assert trait.words.endswith("speed 64 to 95 are alike and 5 more plateaus")


def test_a_reversal_is_told_with_its_numbers() -> None:
    (trait,) = traits(straight([speed & 127 for speed in SPEEDS]))

    assert (trait.kind, trait.places) == (Kind.REVERSED, (127, 128))
    assert trait.words == (
        "speed 128 turns the wheels with 0 (left) and 0 (right), 127 with 127 (left) and 127 "
        "(right): the wheels are slower at the higher speed"
    )


def test_one_wheel_that_falls_is_named() -> None:
    both = tuple(SPEEDS)
    right = tuple(speed & 127 for speed in SPEEDS)
    (trait,) = traits(WheelCurve("speed", Motion.FORWARD, both, both, right))

    assert trait.words.endswith("the right wheel is slower at the higher speed")


@pytest.mark.parametrize("motion", [Motion.FORWARD, Motion.BACKWARD])
@pytest.mark.parametrize("side", [1, -1])
def test_steering_is_judged_by_the_difference_of_the_wheels(side: int, motion: Motion) -> None:
    assert kinds(steered([255 - s for s in SPEEDS], side, motion)) == []
    assert kinds(steered(list(SPEEDS), side, motion)) == [Kind.REVERSED]
    assert kinds(steered([255 - (s & 127) for s in SPEEDS], side, motion)) == [Kind.REVERSED]
    assert kinds(steered([255 - min(s, 200) for s in SPEEDS], side, motion)) == [Kind.FLAT]


def test_a_curve_to_the_other_side_fails_although_it_never_falls() -> None:
    curve = WheelCurve("steering", Motion.FORWARD, (100, 200, 255), (0, 0, 9), (255, 255, 255))
    (trait,) = traits(curve)

    assert trait.places == (0,)
    assert trait.words.endswith("the wheels steer to the other side")


def test_wheels_that_turn_backward_fail_although_they_never_fall() -> None:
    back = (-255, -200, -150)
    (trait,) = traits(WheelCurve("speed", Motion.FORWARD, (0, 128, 255), back, back))

    assert trait.words.endswith("the wheels turn against the motion")


def test_unlike_wheels_are_told() -> None:
    left, right = tuple(SPEEDS), tuple(speed * 9 // 10 for speed in SPEEDS)
    (trait,) = traits(WheelCurve("speed", Motion.FORWARD, left, left, right))

    assert trait.kind is Kind.TOLD
    assert trait.words.startswith("not alike when straight: ")


def test_left_and_right_that_are_not_mirrored_are_told() -> None:
    other = steered([255 - s for s in SPEEDS], -1)
    (trait,) = traits(steered([255 - s // 2 for s in SPEEDS]), [other])

    assert trait.kind is Kind.TOLD
    assert trait.words.startswith("left and right are not mirrored: steering 255 ")
    assert traits(steered([255 - s for s in SPEEDS]), [other]) == ()


@pytest.mark.parametrize("speed", [1, 255])
def test_a_single_speed_is_no_curve_unless_another_sweep_shows_grades(speed: int) -> None:
    curve = straight([speed if setting else 0 for setting in SPEEDS])
    graded = steered([255 - s for s in SPEEDS])

    assert kinds(curve) == [Kind.TOLD]
    assert kinds(curve, graded) == [Kind.FLAT] * (speed > 3)


@given(st.lists(st.tuples(st.integers(-255, 255), st.integers(-255, 255)), min_size=2))
def test_any_curve_is_judged(speeds: list[tuple[int, int]]) -> None:
    left, right = zip(*speeds, strict=True)
    for sign in (1, -1):
        settings = tuple(sign * place for place in range(len(left)))
        for variable in ("speed", "steering"):
            for trait in traits(WheelCurve(variable, Motion.FORWARD, settings, left, right)):
                assert trait.words
