"""What people read: each Python snippet runs as it stands, each command line is one that exists."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.storage import messages, records, recovery
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT
from tests.support.commands import parsed

PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")])
_PATIENCE = 60  # s


def snippets() -> list[tuple[str, str]]:
    """Each Python snippet of the pages, named by page and number."""
    found = []
    for page in PAGES:
        texts = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
        found += [(f"{page.name}-{number}", text) for number, text in enumerate(texts, 1)]
    return found


def command_lines() -> list[tuple[str, str]]:
    """Each command line that a page shows, with the page's name."""
    found = []
    for page in PAGES:
        text = re.sub(r"^```python\n.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        lines = re.findall(r"^    (?:\.venv/bin/)?bilprov (.*)$", text, re.MULTILINE)
        inline = re.findall(r"`bilprov ([a-z][^`]*)`", " ".join(text.split("\n")))
        found += [(page.name, line) for line in [*lines, *inline]]
    return list(dict.fromkeys(found))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder with the capture that the snippets read."""
    path = tmp_path / "drive.mcap"
    with CaptureWriter(path, start_wall=10**18, metadata={}, version="0") as capture:
        for number, frame in enumerate(("1150", "20", "8109", "00")):
            capture.chunk(Chunk(number * 20 * MS, "host", bytes.fromhex(frame)))
            answer = b"\x02" if frame == "8109" else b"\x00"
            capture.chunk(Chunk(number * 20 * MS + MS, "device", answer))
    return tmp_path


@pytest.mark.waits
@pytest.mark.parametrize(("name", "text"), snippets(), ids=[name for name, _ in snippets()])
def test_a_python_snippet_runs_as_it_stands(name: str, text: str, folder: Path) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", text],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        timeout=_PATIENCE,
        check=False,
    )

    assert (result.returncode, result.stderr) == (0, b"")
    assert result.stdout or "print" not in text or "except" in text


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_a_command_line_is_one_that_exists(page: str, line: str) -> None:
    parsed(line)


def test_the_limits_of_a_reader_are_those_that_it_has() -> None:
    text = (ROOT / "docs" / "captures.md").read_text()
    said = dict(re.findall(r"^\| (.+?) \| (.+?) \|$", text, re.MULTILINE))
    mib, kib = 1 << 20, 1 << 10
    limits = {
        "bytes unpacked of all chunks": f"{recovery.UNPACKED_FREE // mib} MiB, and "
        f"{recovery.UNPACKED_SHARE:,} for each byte of the file",
        "messages in chunks": f"{recovery.MESSAGES_FREE:,}, and one for every two bytes "
        "of the file",
        "records outside of chunks, without messages and index": f"{recovery.LOOSE_RECORDS:,}",
        "one chunk, packed or unpacked; any other record": f"{records.CHUNK_BYTES // mib} MiB",
        "data of one message; one text of a header or a channel": (
            f"{records.MESSAGE_BYTES // kib} KiB"
        ),
        "one attachment whose content is read": f"{records.ATTACHMENT_BYTES // mib} MiB",
        "channels; other records in a chunk": f"{records.CHANNELS}; {records.DESCRIPTIONS:,}",
        "messages held back to bring a foreign file into time order": (
            f"{messages.WINDOW_MESSAGES:,}, or {messages.WINDOW_BYTES // mib} MiB"
        ),
    }

    assert {name: said.get(name) for name in limits} == limits
    assert records.RECORD_BYTES == records.CHUNK_BYTES


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_what_a_page_links_to_is_there(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text())

    assert [link for link in links if not (page.parent / link).exists()] == []
