"""The wheels' order at a few settings: devices with their laws of speed, and their verdicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

import msgspec
import pytest

from bilprov.captures.schemas import Look
from bilprov.conformance.api import Options, conform
from bilprov.conformance.cases.case import wheel_orders
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator, answers
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.oracle.wheel_order import judge_order
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.support.faults import made
from tests.support.robots import Hidden

PASS, NON_STRICT, FAIL = Verdict.PASS, Verdict.NON_STRICT, Verdict.FAIL
SKIPPED, INCONCLUSIVE, TOLD = Verdict.SKIPPED, Verdict.INCONCLUSIVE, Verdict.INFORMATIONAL
ONLY = Options(only=("wheels/*",))
STEERING, SPEED = "wheels/steering", "wheels/speed"


def judged(
    protocol: Protocol, fault: Fault | None = None, options: Options = ONLY
) -> dict[str, CaseResult]:
    report = conform(Simulator(protocol, fault), grammar=protocol, options=options)
    return {r.id: r for r in report.results if r.id.startswith("wheels/")}


def verdicts(protocol: Protocol, fault: Fault | None = None) -> dict[str, Verdict]:
    return {ident: result.verdict for ident, result in judged(protocol, fault).items()}


def seen(change: Callable[[Look], dict[str, object]]) -> Fault:
    """A device whose probe shows other wheels."""
    return Fault("x", "test", "", show=lambda look: msgspec.structs.replace(look, **change(look)))


def driving(law: Callable[[int], int]) -> Fault:
    """A device whose wheels turn by this law of the speed that is set."""

    def wheels(look: Look) -> dict[str, object]:
        assert look.speed is not None
        share = law(look.speed) / max(look.speed, 1)
        return {"left": round((look.left or 0) * share), "right": round((look.right or 0) * share)}

    return seen(wheels)


def test_the_settings_follow_from_the_grammar(each_protocol: Protocol) -> None:
    for case in wheel_orders(each_protocol):
        values = [value for value, _ in case.settings]

        assert values == sorted(set(values))
        assert 2 * values[-1] > each_protocol.limits[case.variable][1]
        for value, frame in case.settings:
            spoken = judge(each_protocol, frame)
            assert spoken.instruction is not None
            after = spoken.instruction.effect.apply(each_protocol.power_on, dict(spoken.fields))
            assert getattr(after, case.variable) == value


def test_rest_the_smallest_the_quarters_and_full_are_among_the_speeds(protocol: Protocol) -> None:
    settings = {case.id: [value for value, _ in case.settings] for case in wheel_orders(protocol)}

    assert settings[SPEED] == [0, 1, 31, 47, 63, 95, 127, 191, 255]
    assert settings[STEERING] == [*(-v for v in settings[SPEED][:0:-1]), *settings[SPEED]]


def test_the_reference_passes_with_every_grammar(each_protocol: Protocol) -> None:
    found = verdicts(each_protocol)

    assert set(found) == {case.id for case in wheel_orders(each_protocol)}
    assert set(found.values()) <= {PASS}


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    ("law", "verdict", "words"),
    [
        (lambda s: min(s, 127), FAIL, "half speed is as fast as full"),
        (lambda s: min(s, 191), NON_STRICT, "speed 191 to 255 are alike"),
        (lambda s: s if s > 31 else 0, NON_STRICT, "speed 0 to 31 are alike"),
        (lambda s: s & 127, FAIL, "at 127 with 127 (left) and 127 (right), 191 with 63 (left)"),
        (lambda s: s - 256 * (s > 127), FAIL, "191 with -65 (left) and -65 (right)"),
        (lambda s: s and 256 - s, FAIL, "they are slower at the higher"),
        (lambda s: 255, FAIL, "half speed is as fast as full"),
    ],
    ids=["half", "three-quarters", "dead-zone", "bit-7-lost", "signed", "reversed", "one-speed"],
)
def test_laws_of_speed(
    protocol: Protocol, law: Callable[[int], int], verdict: Verdict, words: str
) -> None:
    result = judged(protocol, driving(law))[SPEED]

    assert result.verdict is verdict
    assert words in result.reason
    assert result.axes["state"].reading == "R-resolution"


def test_one_wheel_that_is_no_faster_above_half_fails(protocol: Protocol) -> None:
    clipped = seen(lambda look: {"left": min(look.left or 0, 127)})

    result = judged(protocol, clipped)[SPEED]

    assert result.verdict is FAIL
    assert "half speed is as fast as full" in result.reason


# What is halved below a fifth of the greatest steering changes the wheels by less than counts.
@pytest.mark.sample(3)
@pytest.mark.parametrize("least", range(48, 256, 8))
@pytest.mark.parametrize("how", ["half", "reversed"])
@pytest.mark.parametrize("variable", ["speed", "steering"])
def test_wheels_that_halve_or_turn_back_from_a_value_on_fail(
    protocol: Protocol, how: str, variable: str, least: int
) -> None:
    fault = made(protocol, f"wheels-astray {how} {variable} {least}")

    assert verdicts(protocol, fault)[f"wheels/{variable}"] is FAIL


def test_unlike_wheels_are_told_and_change_no_exit_code(protocol: Protocol) -> None:
    found = verdicts(protocol, seen(lambda look: {"left": (look.left or 0) * 9 // 10}))

    assert found[SPEED] is TOLD
    assert set(found.values()) <= {PASS, TOLD}


def test_curves_that_are_not_mirrored_are_told() -> None:
    looks = {value: [(100, 100 - (value if value > 0 else value // 2))] for value in (-90, 0, 90)}

    verdict, _, words = judge_order("steering", (1, 1), looks, steers=True)

    assert verdict is TOLD
    assert words.startswith("not mirrored: steering turns the wheels at -90 with")


@pytest.mark.parametrize(("most", "verdict"), [(2, PASS), (25, PASS), (120, INCONCLUSIVE)])
def test_a_probe_with_a_spread_fails_nothing(
    protocol: Protocol, most: int, verdict: Verdict
) -> None:
    random = Random(most)

    def spread(look: Look) -> dict[str, object]:
        def one(speed: int | None) -> int:
            return (speed or 0) + random.randint(-most, most)

        return {"left": one(look.left), "right": one(look.right)}

    assert max(verdicts(protocol, seen(spread)).values()) is verdict


@pytest.mark.parametrize(
    "change",
    [
        lambda look: {"left": None, "right": None},
        lambda look: {"left": None},
        lambda look: {
            "left": (look.left > 0) - (look.left < 0),
            "right": (look.right > 0) - (look.right < 0),
        },
        lambda look: {"moving": False, "motion": "stopped", "left": 0, "right": 0},
    ],
    ids=["no-wheels", "one-wheel", "directions", "never-moves"],
)
def test_a_probe_that_shows_no_speeds_leaves_the_cases_out(
    protocol: Protocol, change: Callable[[Look], dict[str, object]]
) -> None:
    assert set(verdicts(protocol, seen(change)).values()) == {SKIPPED}


def test_a_fall_that_shows_once_is_flaky(protocol: Protocol) -> None:
    count = 0

    def once(look: Look) -> dict[str, object]:
        nonlocal count
        count += look.speed == 95
        return {"left": 0, "right": 0} if look.speed == 95 and count <= 3 else {}

    device = Hidden(Simulator(protocol, seen(once)))
    results = conform(device, grammar=protocol, options=ONLY).results
    (result,) = (result for result in results if result.id == SPEED)

    assert result.verdict is INCONCLUSIVE
    assert result.reason.startswith("flaky, ")


def test_a_setting_that_is_refused_fails_the_answer_axis(protocol: Protocol) -> None:
    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        refused = event.before.moving and 95 in dict(event.judgement.fields).values()
        return (
            replace(answers(reaction, 2), state=device.protocol.power_on) if refused else reaction
        )

    found = judged(protocol, Fault("x", "test", "", react=react))  # type: ignore[arg-type]

    assert found[SPEED].axes["answer"].verdict is FAIL
    assert found[SPEED].reason.startswith("speed 95 was answered ")
