"""A finding of an examination: what was looked at, how it is, and the command that mends it.

And the findings on a capture file: what is damaged, where, and what is lost.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from bilprov.analyzer.transport.errors import LinkError, path_in
from bilprov.analyzer.transport.machine import Machine
from bilprov.captures.errors import CaptureError
from bilprov.captures.text import escape_controls, quantity
from bilprov.captures.topics import GRAMMAR_HASH
from bilprov.spec.protocol import grammar_hash

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.text import Text

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


INDENT = 2 + max(len(grade) for grade in Grade) + 2
"""Columns before a sentence, and before the command below it."""
_STYLES = {
    Grade.FINE: "green",
    Grade.ADVICE: "yellow",
    Grade.UNSEEN: "dim",
    Grade.BLOCKS: "bold red",
}


def title(name: str, machine: Machine | None = None) -> str:
    """The name of a port with what the system knows of its device: a title, ids, its driver."""
    machine, path = machine or Machine(), path_in(name)
    if not path or Path(path).is_file():
        return name or "''"
    device = machine.device(path)
    usb = machine.usb(path)
    driver = machine.driver(path)
    leads = device != path and machine.file(device).exists()
    says = [f"leads to {device}"] if leads else []
    if usb:
        says += [usb.title, f"USB {usb.identity}", usb.serial and f"serial {usb.serial}"]
    says += [driver and f"driver {driver}"]
    known = ", ".join(filter(None, says))
    return f"{name}: {known}" if known else name


def drawn(finding: Finding) -> RenderableType:
    """A finding without its command, which must stay on one line to be copied."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True, min_width=INDENT - 4)
    grid.add_column()
    grade = Text(finding.grade.value, style=_STYLES[finding.grade])
    grid.add_row(grade, Text(escape_controls(finding.sentence)))
    return Padding(grid, (0, 0, 0, 2), expand=False)


def conclusion(names: Sequence[str], findings: Sequence[Finding]) -> Text:
    """The last line: whether the ports can be used."""
    from rich.text import Text

    which = escape_controls(" and ".join(name or "''" for name in names))
    if not usable(findings):
        return Text(
            f"{which} cannot be used as {'they are' if len(names) > 1 else 'it is'}", "bold"
        )
    advice = sum(finding.grade is Grade.ADVICE for finding in findings)
    more = f"; {quantity(advice, 'thing')} to fix" if advice else ""
    return Text(f"{which} can be used{more}", "bold")


_SHOWN = 20  # places of losses that are told one by one


def of_capture(path: Path) -> Iterator[Finding]:
    """Yield the findings on a capture file; one that blocks where anything of it is lost."""
    from bilprov.captures.reader import open_capture

    try:
        capture = open_capture(path)
        losses = list(islice(capture.losses(), _SHOWN + 1))
    except CaptureError as error:
        yield Finding("file", Grade.BLOCKS, str(error))
        return
    left_out = capture.left_out
    size = capture.contents.size
    seconds = (capture.contents.last - capture.contents.first) / 1e9
    messages = quantity(sum(capture.contents.counts.values()), "message")
    yield Finding("file", Grade.FINE, f"{quantity(size, 'byte')}, {messages} over {seconds:.1f} s")
    stated = capture.metadata.get(GRAMMAR_HASH)
    if capture.grammar_text and stated not in (None, grammar_hash(capture.grammar_text)):
        what = "its grammar is damaged (the hash is another): name the grammar with --grammar"
        yield Finding("grammar", Grade.BLOCKS, what)
    for sentence in capture.damage:
        yield Finding("damage", Grade.BLOCKS, sentence)
    for before, after, what in losses[:_SHOWN]:
        when = f"between {before / 1e9:.3f} and {after / 1e9:.3f} s"
        yield Finding("lost", Grade.BLOCKS, f"{when}: {what}")
    if len(losses) > _SHOWN:
        yield Finding("lost", Grade.BLOCKS, "messages are lost in further places")
    incomplete = bool(left_out or capture.damage or losses)
    new = path.with_name(f"{path.stem}-repaired.mcap")
    words = shlex.join(["bilprov", "capture", "repair", str(path), str(new)])
    if capture.unfinished:
        cut = f", and ends inside a record ({quantity(left_out, 'byte')})" if left_out else ""
        then = "" if incomplete else ": repair it to have a finished file"
        yield Finding(
            "end",
            Grade.BLOCKS if left_out else Grade.ADVICE,
            f"it was never finished: its writer was killed or is still writing{cut}; "
            f"up to there it is complete{then}",
            "" if incomplete else words,
        )
    if incomplete:
        share = f"{quantity(left_out, 'byte')} ({left_out / size:.1%}) cannot be read; "
        what = f"{share if left_out else ''}a new file with all the rest"
        yield Finding("mend", Grade.ADVICE, what, words)
