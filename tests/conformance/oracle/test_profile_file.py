"""Profile files: a profile is read back as it was written; files that do not fit are refused."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.analyzer.client.operations import Received
from bilprov.captures.schemas import MS
from bilprov.conformance.oracle.profile import Figures, Profile, profile_from
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS

LED_ID = {"led-id": "9"}
MEASURED: dict[str, Any] = {
    "truncation_timeout_ms": 40.5,
    "stop_latency_ms": 60_000.0,  # the longest
    "watchdog_ms": None,
    "truncated_frames_answered": False,
    "flushes": True,
    "whole_frame": False,
    "led_id": 9,
    "readings": {"R-stop-speed": "zeroed"},
}


def _text(protocol: Protocol, **changed: Any) -> str:
    return Figures(**MEASURED | changed).toml(protocol)


def test_what_was_measured_and_chosen_comes_back(protocol: Protocol) -> None:
    profile = profile_from(protocol, _text(protocol), LED_ID)

    assert profile.truncation_timeout == 40_500_000  # ns
    assert profile.stop_latency == 60_000 * MS
    assert profile.watchdog is None
    assert profile.truncation_answered is False
    assert (profile.flushes, profile.whole_frame) == (True, False)
    assert profile.choices.led_id == 9
    assert profile.choices.word("R-stop-speed") == "zeroed"
    assert profile.choices.differs("R-stop-speed")
    assert profile.choices.allowed == LED_ID


def test_what_was_not_measured_stays_unknown(protocol: Protocol) -> None:
    unknown = dict.fromkeys(MEASURED) | {"readings": {}}
    text = _text(protocol, **unknown)
    profile = profile_from(protocol, text, {})

    assert text.splitlines()[3:] == ["", "[readings]"]
    assert (profile.truncation_timeout, profile.truncation_answered) == (None, None)
    assert profile.choices.led_id is None


@pytest.mark.parametrize(("came", "latencies"), [(4, []), (5, [0]), (6, [1])])
def test_an_answer_that_came_before_its_frame_has_no_latency(
    came: int, latencies: list[int]
) -> None:
    profile = Profile()
    profile.measured(Received(((came, 0), (9, 0)), 9), 5)

    assert (profile.latencies, profile.delays) == (latencies, latencies)


def test_a_line_is_as_unsteady_as_most_of_the_last_answers_to_one_frame_differ() -> None:
    profile, found = Profile(), []
    for delay in range(1000):
        profile.set_up(b"\x20", delay)
        found.append(profile.unsteadiness)

    assert (found[8], found[9], found[999]) == (0, 7, 79)


TIME = r"truncation_timeout_ms( = .* is not a time|`; give a file)"
FLAG = r"Expected `bool .*\$\.flushes.; give a file"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        *(
            ("= 40.5", f"= {word}", TIME)
            for word in ("true", "false", "0", "-1", "60001", '"40"', "nan")
        ),
        *(("flushes = true", f"flushes = {word}", FLAG) for word in ("1", "0", '"true"', "[]")),
        *(
            ("led_id = 9", f"led_id = {other}", f"led_id = {other} is not an unused ID")
            for other in (-1, 0, 8, 16)
        ),
        ("[readings]", "[readings", "it is not TOML"),
        ('sha256 = "', 'sha256 = "0', "made with another grammar"),
        ('[readings]\n"R-stop-speed" = "zeroed"', "readings = 1", r"Expected `object .*readings"),
        ('"zeroed"', '"doubled"', "R-stop-speed = 'doubled' is not a choice"),
        ("R-stop-speed", "R-none", "R-none = 'zeroed' is not a choice"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_a_sentence(
    protocol: Protocol, old: str, new: str, sentence: str
) -> None:
    text = _text(protocol)
    assert text.count(old) == 1

    with pytest.raises(ValueError, match=sentence):
        profile_from(protocol, text.replace(old, new), LED_ID)


def test_a_choice_that_has_to_be_allowed_is_refused_without_its_option(protocol: Protocol) -> None:
    needing = [
        (name, choice.word, choice.option)
        for name, point in POINTS.items()
        for choice in point.choices
        if choice.option
    ]
    assert needing
    for point, word, option in needing:
        text = _text(protocol, readings={point: word}, led_id=None)
        name, _, value = option.partition("=")
        assert profile_from(protocol, text, {name: value}).choices.word(point) == word
        with pytest.raises(ValueError, match="has to be allowed: see --allow"):
            profile_from(protocol, text, {})
