"""Wording of observations: it names only what the probe can observe."""

from __future__ import annotations

import pytest

from bilprov.captures.schemas import Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.oracle.judge import look_words


@pytest.mark.parametrize(
    ("look", "words"),
    [
        (CarLook(0, None), "moving unknown"),
        (CarLook(0, False, "stopped", 0), "stopped, speed 0"),
        (CarLook(0, True, "forward", left=9, right=-7), "moving forward, wheels 9/-7"),
        (CarLook(0, True, left=9), "moving"),
        (CarLook(0, True, right=9, led=3), "moving, led 3"),
    ],
)
def test_what_the_probe_cannot_tell_is_left_out(look: Look, words: str) -> None:
    assert look_words(look) == words
