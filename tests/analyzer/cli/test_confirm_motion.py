"""Whether a command asks before it makes a device move."""

from __future__ import annotations

import io

import pytest

from bilprov.analyzer.cli.options import NotConfirmed, confirm_effect
from bilprov.spec.by_effect import effect_words
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import still_grammar


def test_where_no_instruction_sets_a_motion_nothing_is_asked(
    protocol: Protocol, grammar_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(NotConfirmed):
        confirm_effect(protocol, "it drives", effect_words(protocol), yes=False)
    still = load(still_grammar(grammar_text))
    confirm_effect(still, "it is sent no motion", effect_words(still), yes=False)
