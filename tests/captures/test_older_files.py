"""Files written before the code became the package `bilprov` still load."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bilprov.spec.protocol import Protocol, load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations
from tests.support import ROOT
from tests.support.commands import command

SHA256 = "784fbb0b76e02c6703df30b623f9ed0d040db9d062dba0396b23863fe89ae234"  # as it was told then


def bare(text: str) -> str:
    """The grammar's text in the older spelling."""
    return text.replace("from bilprov.spec.", "from spec.")


def test_the_grammar_has_the_hash_that_it_had(protocol: Protocol, grammar_text: str) -> None:
    assert "\nfrom bilprov.spec." in grammar_text
    assert protocol.sha256 == load(bare(grammar_text)).sha256 == SHA256


def test_any_other_change_of_the_text_changes_the_hash(grammar_text: str) -> None:
    for other in (
        grammar_text + "\n",
        grammar_text.replace("from bilprov.spec.", "from bilprov.spec .", 1),
    ):
        assert load(other).sha256 != SHA256


def test_both_spellings_are_declarations_and_nothing_else_of_either_is(grammar_text: str) -> None:
    for text in (grammar_text, bare(grammar_text)):
        require_declarations(text)
        for name in ("spec", "bilprov.spec"):
            with pytest.raises(NotDeclared, match=re.escape(f"from {name}.codec import judge")):
                require_declarations(f"{text}\nfrom {name}.codec import judge\n")


# -- the golden captures decode as they did when they were recorded --------------------------------


SAMPLES = ROOT / "captures" / "samples"


@pytest.mark.parametrize("sample", sorted(SAMPLES.glob("*.mcap")), ids=lambda path: path.name)
def test_a_golden_capture_replays_as_it_did(sample: Path) -> None:
    replayed = command("replay", str(sample), "--rate", "0", "--format", "jsonl")

    assert (replayed.returncode, replayed.stderr) == (0, b"")
    assert replayed.stdout == sample.with_suffix(".jsonl").read_bytes()
    assert sample.stat().st_size < 100_000
