"""Whether a command asks before it makes a device move."""

from __future__ import annotations

import io

import pytest

from bilprov.analyzer.cli.options import NotConfirmed, confirm_motion
from bilprov.spec.protocol import Protocol, load
from tests.support.grammars import still_grammar


def test_where_no_instruction_sets_a_motion_nothing_is_asked(
    protocol: Protocol, grammar_text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(NotConfirmed):
        confirm_motion(protocol, "it drives", yes=False)
    confirm_motion(load(still_grammar(grammar_text)), "it is sent no motion", yes=False)
