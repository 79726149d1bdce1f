"""A car whose variables and motions have other names is judged as the robot car is."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.dut.target import device_target
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.json_report import as_json
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import mutated
from tests.support.robots import simulated

# In the same alphabetical order as the car's.
NAMES = {"motion": "mode", "speed": "pace", "steering": "turn", "led": "lamp"}
WORDS = {
    "stopped": "still",
    "forward": "onward",
    "backward": "astern",
    "rotate_right": "spin_right",
    "rotate_left": "spin_left",
}
DEVICES = (
    *("", "no-stop-on-bad-data", "left-is-signed", "led-order-reversed", "speed-stops-it"),
    *("moves-at-power-on", "stop-keeps-one-wheel", "no-faster-above-half-speed"),
    *("restarts-after-stop", "R-stop-speed=zeroed", "R-steer-rotating=curve", "random:5.3"),
)


def renamed(text: str) -> str:
    """The grammar with other names of variables and kinds of motion."""
    values = "|".join(("Word", "Whole", "Bits", "From", "0", *(f'"{word}"' for word in WORDS)))
    for name, other in NAMES.items():
        text = re.sub(rf"\b{name}=(?={values})", f"{other}=", text)
        text = re.sub(rf'(by|speed|steering)="{name}"', rf'\1="{other}"', text)
    for word, other in WORDS.items():
        text = text.replace(f'"{word}"', f'"{other}"')
    return text


def judged(protocol: Protocol, name: str, level: str) -> list[dict[str, object]]:
    """The cases and causes of a report, with the same names for both cars."""
    target = device_target(protocol, simulated(protocol, name))
    report = json.loads(as_json(run_suite(target, Options(level=level))))
    text = json.dumps([report[key] for key in ("verdict", "cases", "causes", "counts", "coverage")])
    for own, other in (NAMES | WORDS).items():
        text = re.sub(rf"\b{other}\b", own, text)
    text = text.replace("LED", "led").replace("--grammar other ", "")
    found: list[dict[str, object]] = json.loads(text)
    return found


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", DEVICES)
def test_the_suite_knows_a_car_by_its_declarations(
    protocol: Protocol, grammar_text: str, name: str
) -> None:
    other = load(renamed(grammar_text), "other")
    assert other.settings == ("pace", "turn", "lamp")
    assert judged(other, name, "smoke") == judged(protocol, name, "smoke")


def test_a_variable_that_a_grammar_adds_is_judged_too(horn_text: str) -> None:
    changes = {
        'led=Bits("RGB"),': 'led=Bits("RGB"),\n    horn=Whole(0, 3),',
        'document="Tuta"': 'document="Tuta", effect=Sets(horn=From("sound"))',
    }
    protocol = load(mutated(horn_text, changes))

    def mutes(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        return replace(reaction, state=reaction.state.but(horn=0))

    for fault, failed in ((None, set()), (Fault("mute", "test", "", react=mutes), {1, 2, 3})):
        target = device_target(protocol, Simulator(protocol, fault))
        report = run_suite(target, Options(level="standard", only=("valid/Horn/*",)))
        reasons = {r.id: r.reason for r in report.results if r.verdict is Verdict.FAIL}
        assert reasons == {f"valid/Horn/{n}": f"horn is 0, expected {n}" for n in failed}
