"""Legal answers: which other answers to a frame some reading of the document allows."""

from __future__ import annotations

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.legal_answers import other_choices
from bilprov.spec.protocol import Protocol

SILENT = (None, "R-truncated-known")


@pytest.mark.parametrize(
    ("frame", "choices"),
    [
        ("20", []),
        ("11 7f", []),
        ("81 09", []),
        ("10", []),
        ("f0", []),
        ("f1 00", [(3, "R-unused-length"), (4, "R-unused-length")]),
        ("12 00 00", []),  # Speed takes every byte
        ("82 05 00", []),
        ("82 09 00", [(2, "R-competing-errors")]),
        ("11", [SILENT]),
        ("12 00", [(3, "R-truncated-long"), SILENT]),
        ("f1", [(4, "R-truncated-unused"), (3, "R-truncated-unused"), SILENT]),
    ],
)
def test_the_answers_that_another_reading_allows(
    protocol: Protocol, frame: str, choices: list[tuple[int | None, str]]
) -> None:
    assert list(other_choices(protocol, judge(protocol, bytes.fromhex(frame)))) == choices
