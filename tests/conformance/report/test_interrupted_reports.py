"""Ctrl-C once the run is over: every report is written whole, and the exit status is the verdict's.

A report that existed is never half replaced, and no temporary file is left beside it.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import pytest

from tests.support.commands import command

FAULTY = ("conform", "sim", "--only", "valid/LED/1", "--fault", "always-1")
REPORTS = ("json", "junit", "html", "profile")
# What Python reports to audit hooks: a report is begun, a report is complete under another name.
OPENED, RENAMED = "open", "os.rename"
RUN_IS_OVER = "socket.gethostname"  # the report gets the name of the host


@dataclass
class Interrupts:
    """Sends SIGINT at some events; `file` is part of the name of the file that the event is of."""

    events: tuple[str, ...] = ()
    file: str = ""
    sent: list[str] = field(default_factory=list)

    def heard(self, event: str, arguments: tuple[object, ...]) -> None:
        file = str(arguments[0]) if arguments else ""
        of_a_part = event == RUN_IS_OVER or (file.endswith(".part") and self.file in file)
        if event in self.events and of_a_part:
            self.sent.append(event)
            signal.raise_signal(signal.SIGINT)


_heard_by = Interrupts()
_hooked: list[bool] = []


@pytest.fixture
def interrupts() -> Iterator[Interrupts]:
    """What sends SIGINT; none of the events is heard until the test names them."""
    global _heard_by
    if not _hooked:  # a hook stays for ever
        sys.addaudithook(lambda event, arguments: _heard_by.heard(event, arguments))
        _hooked.append(True)
    _heard_by = Interrupts()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # also in the background
    yield _heard_by
    _heard_by = Interrupts()
    signal.signal(signal.SIGINT, before)


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("events", "file"),
    [
        ((RUN_IS_OVER,), ""),
        *(((event,), f".{name}.") for name in REPORTS for event in (OPENED, RENAMED)),
        ((RUN_IS_OVER, OPENED, RENAMED), ""),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, tuple) else value,
)
def test_ctrl_c_while_reports_are_written_leaves_each_whole(
    interrupts: Interrupts, events: tuple[str, ...], file: str, tmp_path: Path
) -> None:
    for old in ("json", "html"):
        (tmp_path / old).write_text("old")
    interrupts.events, interrupts.file = events, file

    files = [word for name in REPORTS for word in (f"--{name}", str(tmp_path / name))]
    done = command(*FAULTY, *files, XDG_STATE_HOME=str(tmp_path / "state"))

    assert set(interrupts.sent) == set(events)
    assert (done.returncode, b"Traceback" in done.stderr) == (1, False)
    assert {path.name for path in tmp_path.iterdir()} == {*REPORTS, "state"}
    assert msgspec.json.decode((tmp_path / "json").read_bytes())["exit"] == 1
    assert ElementTree.parse(tmp_path / "junit").getroot().tag == "testsuites"
    assert (tmp_path / "html").read_text().endswith("</html>\n")
    assert (tmp_path / "profile").read_text().endswith("\n")
