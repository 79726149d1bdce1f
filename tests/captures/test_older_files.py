"""Files written before the code became the package `bilprov` still load."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import pytest

from bilprov.captures.reader import open_capture
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.safe_grammar import NotDeclared, require_declarations
from tests.support import ROOT
from tests.support.commands import command

OLD = ROOT / "captures" / "samples" / "older"
SHA256 = "784fbb0b76e02c6703df30b623f9ed0d040db9d062dba0396b23863fe89ae234"  # as it was told then


def bare(text: str) -> str:
    """The grammar's text in the older spelling."""
    return text.replace("from bilprov.spec.", "from spec.")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "conform.mcap"
    path.write_bytes(gzip.decompress((OLD / "conform.mcap.gz").read_bytes()))
    return path


def test_the_grammar_has_the_hash_that_it_had(protocol: Protocol, grammar_text: str) -> None:
    assert "\nfrom bilprov.spec." in grammar_text
    assert protocol.sha256 == load(bare(grammar_text)).sha256 == SHA256


def test_any_other_change_of_the_text_changes_the_hash(grammar_text: str) -> None:
    for other in (
        grammar_text + "\n",
        grammar_text.replace("from bilprov.spec.", "from bilprov.spec .", 1),
    ):
        assert load(other).sha256 != SHA256


def test_an_old_recording_is_judged_as_far_as_this_version_makes_its_cases(
    recording: Path,
) -> None:
    result = command("recheck", str(recording))

    assert result.returncode == 3, result.stderr
    assert result.stderr.startswith(b"it was recorded by bilprov 0.1.0")
    assert b"no longer makes all of its cases in the way they were recorded" in result.stderr
    assert result.stdout.startswith(b"the same: ")
    assert open_capture(recording).damage == ()


def test_an_old_profile_is_taken(tmp_path: Path) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_bytes((OLD / "profile.toml").read_bytes())

    result = command("conform", "sim", "--only", "valid/LED/1", "--profile", str(profile))

    assert result.returncode == 0, result.stderr


def test_both_spellings_are_declarations_and_nothing_else_of_either_is(grammar_text: str) -> None:
    for text in (grammar_text, bare(grammar_text)):
        require_declarations(text)
        for name in ("spec", "bilprov.spec"):
            with pytest.raises(NotDeclared, match=re.escape(f"from {name}.codec import judge")):
                require_declarations(f"{text}\nfrom {name}.codec import judge\n")
