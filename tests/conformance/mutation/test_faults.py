"""Faults of the bank: their words, what catches them, what explains them."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import pytest

from bilprov.captures.schemas import MS
from bilprov.conformance.cases.steps import FrameClass
from bilprov.conformance.dut.simulator import CONFORMING, Fault, Simulator
from bilprov.conformance.mutation import triggers
from bilprov.conformance.mutation.effects import EFFECTS, WATCHING
from bilprov.conformance.mutation.faults import (
    Family,
    Row,
    VariantRow,
    all_faults,
    fault_bank,
    filled,
    globs,
    hooks,
    table,
)
from bilprov.conformance.mutation.hooks import HOOKS
from bilprov.conformance.mutation.score import (
    CauseScore,
    Explained,
    both,
    cause_score,
    drawn_pairs,
    explained,
)
from bilprov.conformance.mutation.triggers import SUBJECTS, trigger
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.spec.fields import Clauses
from bilprov.spec.protocol import Protocol
from tests.support.faults import BANK, made
from tests.support.robots import CountingLink, at_rest, cases_of, failing, matching, run_over

# What each of these breaks, typed by hand: all of these cases fail, and no other.
EXACTLY = {
    "ok-to-unknown-id": ["unused-id/*", "recovery/unused-id/*", "link/unused-id"],
    "ok-to-too-many": ["wrong-length/*/[1-9]", "wrong-length/*/1?", "recovery/too-many/*"],
    "wrong-code-for-truncated": ["truncated/*", "recovery/truncated/*", "timing/truncation-*"],
    "no-stop-on-bad-data": ["bad-data/*", "recovery/bad-data/*"],
    "accepts-id-15": ["unused-id/15/*", "truncated/15/*"],
    "accepts-led-bit-3": ["bad-data/LED/[89]", "bad-data/LED/1[0-5]", "recovery/bad-data/*"],
    "swallows-missing-data": ["wrong-length/[SRL][!t]*/0"],
    "stop-does-nothing": ["valid/Stop", "leave/stopped"],
}

# What a case's id begins with where single frames are the case.
SINGLE = (*FrameClass, "link", "line", "timing", "leave")


def by_single_frames(fault: Fault) -> bool:
    """Whether single frames are meant to catch it, and nothing else is."""
    return all(glob == "*" or glob.split("/")[0] in SINGLE for glob in fault.caught_by)


def test_every_fault_says_what_it_does_and_which_clauses_it_breaks(protocol: Protocol) -> None:
    bank = fault_bank(protocol)

    assert len({fault.doc for fault in bank.values()}) == len(bank)
    for name, fault in bank.items():
        assert name == fault.name
        assert {*fault.clauses} <= {*Clauses.__struct_fields__}, name
        assert fault.clauses, name


def test_no_two_faults_have_one_name(protocol: Protocol, horn: Protocol) -> None:
    for grammar in (protocol, horn):
        names = [fault.name for fault in all_faults(grammar)]
        assert len(names) == len(set(names))


def test_only_a_broken_line_ends_in_2_and_only_no_motion_at_all_in_3(protocol: Protocol) -> None:
    exits = {name: fault.exit for name, fault in fault_bank(protocol).items() if fault.exit != 1}

    assert exits == {"echo": 2, "dead": 2, "never-moves": 3}


def test_a_fault_that_fails_says_which_cases_catch_it(protocol: Protocol) -> None:
    for name, fault in fault_bank(protocol).items():
        assert bool(fault.caught_by) is (fault.exit == 1), name
    # Of some too little is left to judge one by one: what else they break is not named.
    assert sum("*" in fault.caught_by for fault in fault_bank(protocol).values()) == 7


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, fault in BANK.items() if by_single_frames(fault)])
def test_a_fault_fails_the_cases_that_are_meant_to_catch_it(protocol: Protocol, name: str) -> None:
    fault = fault_bank(protocol)[name]
    device = Simulator(protocol, fault)
    cases = cases_of(protocol)

    runner = run_over(CountingLink(device), protocol, cases)

    results = runner.run.results
    found = failing(results)
    assert bool(runner.unusable) is (results == []) is (fault.exit == 2)
    assert Verdict.ERROR not in {result.verdict for result in results}
    assert {ident for ident in found if not matching(ident, fault.caught_by)} == set()
    ids = {case.id for case in cases} if results else set()
    tried = [glob for glob in fault.caught_by if any(matching(i, (glob,)) for i in ids)]
    assert [glob for glob in tried if not any(matching(i, (glob,)) for i in found)] == []
    assert sorted(result.id for result in results if result.id in ids) == sorted(ids)
    if name in EXACTLY:
        all_ids = (result.id for result in results)
        assert found == {ident for ident in all_ids if matching(ident, EXACTLY[name])}
    assert at_rest(device) or name in ("stop-does-nothing", "restarts-by-itself")


@pytest.mark.slow
def test_the_reference_passes_every_single_frame_there_is(
    protocol: Protocol, pytestconfig: pytest.Config
) -> None:
    whole = pytestconfig.getoption("--whole")
    cases = cases_of(protocol, every_cut=whole)
    runner = run_over(CountingLink(Simulator(protocol)), protocol, cases)

    # Valid, unused, wrong lengths, bad data, cuts (every one there is, or some), and recovery
    assert len(cases) == 781 + 112 + 135 + 248 + (1920 if whole else 20) + 20
    # Without a power switch there is no second power-on.
    odd = [r.id for r in runner.run.results if r.verdict is not Verdict.PASS]
    assert odd == ["power-on/Forward"]


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
    assert subjects >= {*SUBJECTS, "times"}
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


def test_of_two_faults_each_remembers_its_own(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    pair = bank["bad-data-fine-once-too-many-came"], bank["stays-dead-after-two-faults"]
    device = Simulator(protocol, both(*pair))
    for at, frame in enumerate(["11 ff", "21 00", "20"]):
        device.receive(bytes.fromhex(frame), at * MS)
    assert device.state.moving


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


def test_a_mixture_is_compared_with_what_the_device_has_chosen(protocol: Protocol) -> None:
    found = explained(protocol, ["mixture:R-fault-state=speed-zeroed:by-motion"], "smoke", 1)
    assert (found.causes, found.named, found.of, found.shown) == (1, 1, 1, True)


@pytest.mark.slow
def test_of_two_faults_each_has_its_cause(protocol: Protocol) -> None:
    score = cause_score(protocol, ["no-stop-on-truncated", "speed-bit-0-lost"], 1, "smoke")
    [pair] = score.pairs
    assert pair.name == "no-stop-on-truncated and speed-bit-0-lost"
    assert (pair.named, pair.of) == (2, 2)
    assert list(score.sentences()) == [
        "2 of 2 faults are exactly one cause, which names the trigger if it is known",
        "2 of 2 faults are at most two causes",
        "2 of 2 first causes show with their line on a device just switched on",
        "1 of 1 pairs have both faults among the first 3 causes",
        "in 0 other pairs one fault changes no verdict beside the other",
    ]


@pytest.mark.slow
def test_what_says_little_of_itself_joins_the_simplest_cause(protocol: Protocol) -> None:
    names = ["mixture:R-stop-speed=zeroed:by-frame", "random:15"]
    found = explained(protocol, names, "smoke", 1)
    assert (found.causes, found.named, found.of) == (2, 2, 2)


@pytest.mark.slow
def test_a_fault_that_another_one_hides_is_counted_apart(protocol: Protocol) -> None:
    names = ["no-stop-on-too-few", "random:24"]
    found = explained(protocol, names, "smoke", 1)
    assert (found.named, found.of, found.hidden) == (1, 2, 1)
    sentences = list(CauseScore((), (found,)).sentences())
    assert sentences[-2:] == [
        "0 of 0 pairs have both faults among the first 3 causes",
        "in 1 other pairs one fault changes no verdict beside the other",
    ]


def test_what_is_not_named_is_not_counted() -> None:
    other = Explained("other", 5, causes=1, named=0, of=1, shown=False)
    many = Explained("many", 5, causes=3, named=1, of=1, shown=True)
    unseen = Explained("unseen", 0)
    score = CauseScore((other, many, unseen), ())
    assert [sentence.split(" ")[0] for sentence in score.sentences()] == ["0", "1", "1"]


def test_pairs_are_of_different_families_and_drawn_by_the_seed(protocol: Protocol) -> None:
    bank = fault_bank(protocol)
    pairs = drawn_pairs(protocol, list(bank), 20, 7)
    assert pairs == drawn_pairs(protocol, list(bank), 20, 7)
    assert pairs != drawn_pairs(protocol, list(bank), 20, 8)
    assert all(bank[one].family != bank[other].family for one, other in pairs)
