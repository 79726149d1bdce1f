"""The words of which faults are made: triggers (when), effects and hooks (what), templates.

`words.toml` says what each word does: when a trigger holds, what a device answers and shows.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.fault import CONFORMING
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation import triggers
from bilprov.conformance.mutation.effects import EFFECTS, WATCHING
from bilprov.conformance.mutation.faults import Family, Row, filled, globs, hooks, table
from bilprov.conformance.mutation.hooks import HOOKS
from bilprov.conformance.mutation.triggers import FRAME, HISTORY, STATE, trigger
from bilprov.conformance.mutation.variants import VariantRow
from bilprov.spec.protocol import Protocol
from tests.support.faults import made

WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
SENT, HOLDS = WORDS["triggers"]["sent"], WORDS["triggers"]["holds"]
CONFORMS = [(group["sent"], *group["rows"][0]) for group in WORDS["devices"]]
MISBEHAVES = [(group["sent"], *row) for group in WORDS["devices"] for row in group["rows"][1:]]
SHOWN = attrgetter("motion", "speed", "steering", "led", "left", "right")
TURN, SILENCE = 2 * MS, {"|": 100 * MS, "~": 200 * MS}


def answered(robot: Simulator, sent: str) -> tuple[list[bytes], int]:
    """What the robot answers to each word until the next, and the time after the last (ns)."""
    found, now = [], 0
    for word in sent.split():
        for part in word.rstrip("|~").split("-"):
            for byte in bytes.fromhex(part):
                robot.receive(bytes([byte]), now)
            now += TURN
        now += SILENCE.get(word[-1], TURN) - TURN
        found.append(robot.advance(now - 1))
    return found, now - 1


@pytest.mark.parametrize("words", HOLDS)
def test_a_trigger_holds_at_these_frames(protocol: Protocol, words: str) -> None:
    row = Row("", "twice", *words.split("; "))
    doubling = replace(made(protocol, "twice"), **hooks(protocol, row))
    said, _ = answered(Simulator(protocol, doubling), SENT)
    due, _ = answered(Simulator(protocol), SENT)

    more = [len(one) > len(other) for one, other in zip(said, due, strict=True)]
    assert [turn for turn, holds in enumerate(more) if holds] == HOLDS[words]


@pytest.mark.parametrize(("sent", "what", "when", "codes", "seen"), [*CONFORMS, *MISBEHAVES])
def test_a_device_does_what_its_words_say(
    protocol: Protocol, sent: str, what: str, when: str, codes: str, seen: str
) -> None:
    robot = Simulator(protocol, made(protocol, what, when) if what else CONFORMING)

    said, now = answered(robot, sent)

    assert " ".join(one.hex() or "-" for one in said) == codes
    assert " ".join(map(str, SHOWN(robot.look(now)))) == seen


def words_of(texts: Iterator[str]) -> set[str]:
    """The words of what devices do."""
    return {part.split()[0] for text in texts for part in text.split(";") if part}


def test_each_word_is_tried_and_makes_a_difference(protocol: Protocol) -> None:
    conforming = {sent: seen for sent, _, _, *seen in CONFORMS}
    subjects = {word for when in HOLDS for term in when.split(",") for word in term.split()[:2]}

    assert [row for row in MISBEHAVES if list(row[3:]) == conforming[row[0]]] == []
    assert words_of(row[1] for row in MISBEHAVES) == {*EFFECTS, *WATCHING, *HOOKS}
    assert subjects >= {*FRAME, *STATE, *HISTORY, *triggers.COUNTERS, "times"}
    assert set(triggers.OPERATORS) - subjects == {"", "==", "!="}
    assert all(len(held) > 0 for held in HOLDS.values())


def test_each_word_is_one_of_a_table_or_of_what_is_drawn() -> None:
    families = table("faults.toml", dict[str, Family]).values()
    rows = [row for family in families for row in family.faults.values()]
    rows += table("variants.toml", dict[str, VariantRow]).values()
    drawn = {"turns-bits", "wheels-astray", "loses-next-byte", "chooses"}

    assert words_of(row.what for row in rows) | drawn == {*EFFECTS, *WATCHING, *HOOKS}


@pytest.mark.parametrize("text", ["nothing", "valid, sped > 3"])
def test_an_unknown_word_of_a_trigger_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a trigger has no subject"):
        trigger(text)


def test_a_template_is_filled_in_for_each_and_left_out_where_a_name_is_missing(
    protocol: Protocol,
) -> None:
    rows = {
        "{each}-late": Row("{each}", "late 1", "instruction {each}", each="steering"),
        "missing": Row("", "silent", "id {unused[99]}"),
        "unknown": Row("", "silent", "id {no_such}"),
    }

    found = {name: row.when for name, row in filled(protocol, rows)}

    assert found == {"Right-late": "instruction Right", "Left-late": "instruction Left"}


def test_words_of_cases_stand_for_globs() -> None:
    truncated = ("truncated/*", "recovery/truncated/*", "timing/truncation-timeout")

    assert globs("truncated valid/*") == (*truncated, "valid/*")
