"""A finding of an examination: what was looked at, how it is, and the command that mends it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from bilprov.analyzer.transport.errors import LinkError

_SHORT = 100  # characters of a command that fits into a note


class Grade(StrEnum):
    """How a finding is: fine, worth a change, not to be seen from here, or in the way."""

    FINE = "ok"
    ADVICE = "advice"
    UNSEEN = "unseen"
    BLOCKS = "blocks"


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found: a sentence, and the command that mends it, "" where none does."""

    check: str
    grade: Grade
    sentence: str
    command: str = ""

    def note(self, name: str) -> str:
        """The finding in one line, for a command that uses the port `name` all the same."""
        mends = self.command
        if len(mends) > _SHORT:
            mends = f"`bilprov ports {name}` prints the command"
        return f"{self.sentence}: {mends}" if mends else self.sentence


def refused(check: str, error: LinkError) -> Finding:
    """The finding that the port cannot be used, for the reason that the error says."""
    return Finding(check, Grade.BLOCKS, error.sentence, error.command)


def usable(findings: Iterable[Finding]) -> bool:
    """Whether the port can be used as it is."""
    return all(finding.grade is not Grade.BLOCKS for finding in findings)
