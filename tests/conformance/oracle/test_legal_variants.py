"""Legal variants, and devices that mix two of them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec
import pytest

from bilprov.captures.schemas import MS, Look
from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.mutation.catalogue import find_fault, find_variant
from bilprov.conformance.mutation.faults import variants
from bilprov.conformance.oracle.judge import look_words
from bilprov.conformance.oracle.verdicts import LABELS, Verdict
from bilprov.spec.codec import build, raw_frame
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import READINGS
from tests.conformance.mutation.test_verdicts import TABLE
from tests.support.faults import faulty, sets, stands_still, when
from tests.support.robots import CountingLink, cases_of, run_over, simulated

FAIL, INFORMATIONAL = Verdict.FAIL, Verdict.INFORMATIONAL
NON_STRICT, PASS = Verdict.NON_STRICT, Verdict.PASS

ALLOWED = (NON_STRICT, PASS)  # with the option; what a device must not be sent is left out
VARIANTS = tomllib.loads(
    Path(__file__).parents[1].joinpath("variants.toml").read_text(encoding="utf-8")
)
VERDICTS = {name: LABELS[row["verdict"]] for name, row in VARIANTS.items()}


class TellingOnlyWhetherItMoves(Simulator):
    """Its probe sees no speed, so that a speed that a fault has zeroed shows only by standing."""

    def look(self, now: int) -> Look:
        return CarLook(t=now, moving=super().look(now).moving)


def test_every_variant_has_its_verdict_here_and_every_other_choice_its_variant(
    protocol: Protocol,
) -> None:
    known = variants(protocol)

    assert set(known) == set(VERDICTS)
    for variant in known.values():
        assert (VERDICTS[variant.name] is FAIL) is bool(variant.row.allow)
    # Where the readings let another choice pass, there is a device that takes it.
    legal = {
        reading.id
        for reading in READINGS
        if any(
            verdict.split()[0] != "fail" or "allowed" in verdict for _, verdict in reading.others
        )
    }
    assert legal == {variant.name.split("=")[0] for variant in known.values()}


class TellingItsWheels(Simulator):
    """Its probe tells the wheels and the light, and no value that was set."""

    def look(self, now: int) -> Look:
        return msgspec.structs.replace(super().look(now), speed=None, steering=None)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("R-drive-steering=straight", None),  # a drive hides what a rotation has kept
        ("R-rotate-steering=reset", "reset"),
        ("R-stop-speed=zeroed", "kept"),
    ],
)
def test_what_a_rotation_does_to_the_steering_shows_by_the_wheels_when_it_drives_again(
    protocol: Protocol, name: str, word: str | None
) -> None:
    device = TellingItsWheels(protocol, find_variant(protocol, name))
    report = conform(device, grammar=protocol, options=Options(level="smoke"))

    assert report.exit != 1
    assert (report.profile.readings or {}).get("R-rotate-steering") == word


def test_another_legal_reading_gets_its_verdict_and_never_a_failure() -> None:
    standard = {row[2]: row[1] for row in map(str.split, TABLE) if row[0] == "standard"}

    for name, verdict in VERDICTS.items():
        # The table is made with the options that readings need.
        possible = ALLOWED if verdict is FAIL else (verdict,)
        assert standard[name] in {one.label for one in possible}, name


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, verdict in VERDICTS.items() if verdict is FAIL])
def test_a_reading_that_needs_an_option_fails_without_it(name: str, protocol: Protocol) -> None:
    device = simulated(protocol, name)

    assert conform(device, grammar=protocol, options=Options(level="smoke")).exit == 1


def test_a_probe_that_sees_only_motion_does_not_take_a_zeroed_speed_for_a_broken_restart(
    protocol: Protocol,
) -> None:
    fault = Fault("variant", "variant", "", react=when(faulty, sets(speed=0)))
    device = TellingOnlyWhetherItMoves(protocol, fault)
    runner = run_over(
        CountingLink(device), protocol, cases_of(protocol, "unused-id/9/*"), discover=True
    )

    verdicts = {r.verdict for r in runner.run.results if r.id.startswith("unused-id")}
    assert verdicts == {INFORMATIONAL}


def test_but_a_robot_that_no_new_speed_wakes_after_a_fault_fails(protocol: Protocol) -> None:
    def dead(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        broken = device.faults > 3 or not event.judgement.valid
        return stands_still(device, event, reaction) if broken else reaction

    fault = Fault("dead", "variant", "", react=dead)
    device = TellingOnlyWhetherItMoves(protocol, fault)
    runner = run_over(
        CountingLink(device), protocol, cases_of(protocol, "unused-id/9/*"), discover=True
    )

    assert Verdict.FAIL in {result.verdict for result in runner.run.results}


def speeds_after_stops(protocol: Protocol, name: str, *movers: str) -> list[int]:
    """The speed that is left after each Stop: Speed 99, a motion, Stop, and again."""
    device, now, found = Simulator(protocol, find_variant(protocol, name)), 0, []
    for mover in movers:
        now += 10 * MS
        frames = (build(protocol, "Speed", {"speed": 99}), build(protocol, mover))
        device.receive(b"".join(frames) + build(protocol, "Stop"), now)
        found.append(device.state.speed)
    return found


MOVERS = ("Forward", "Backward", "RotateRight", "RotateLeft")


@pytest.mark.parametrize(
    ("by", "movers", "speeds"),
    [
        ("by-frame", ["Forward"] * 4, [0, 99, 0, 99]),
        ("after-12", ["Forward"] * 15, [99] * 12 + [0] * 3),
        ("by-motion", [*MOVERS, *MOVERS], [0, 99, 0, 99] * 2),
    ],
)
def test_a_mixture_chooses_now_one_and_now_the_other(
    protocol: Protocol, by: str, movers: list[str], speeds: list[int]
) -> None:
    assert speeds_after_stops(protocol, f"mixture:R-stop-speed=zeroed:{by}", *movers) == speeds


def test_by_id_it_depends_on_the_instruction(protocol: Protocol) -> None:
    name = "mixture:R-unused-length=too-many:by-id"
    codes = []
    for identity in protocol.unused_ids:
        device = Simulator(protocol, find_variant(protocol, name))
        device.receive(raw_frame(protocol, identity, 1, b"\0"), 0)
        codes.append(device.advance(0)[0])

    assert codes == [3, 1, 3, 1, 3, 1, 3]


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    "name", ["mixture:", "mixture:R-stop-speed=zeroed:by-id", "mixture:x:by-frame"]
)
def test_a_mixture_that_is_none_is_refused(protocol: Protocol, name: str) -> None:
    with pytest.raises(ValueError, match="there is no variant"):
        find_fault(protocol, name)


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
