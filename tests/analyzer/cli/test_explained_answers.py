"""`bilprov.explain` of answers of several bytes; of the commands there are transcripts."""

from __future__ import annotations

import pytest

from bilprov.analyzer import api
from bilprov.analyzer.grammar_file import load_protocol


def test_python_explains_an_answer_by_its_request() -> None:
    protocol = load_protocol("stk500v1")
    (one,) = api.explain(b"\x14\x03\x10", "device", protocol, b"\x41\x81\x20").responses
    names = [group.name for group in one.groups]
    assert (one.words, names) == ("OK value=3", ["insync", "value", "code"])
    with pytest.raises(ValueError, match="41 81 is not answered"):
        api.explain(b"\x14\x10", "device", protocol, b"\x41\x81")
