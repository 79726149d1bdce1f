"""Captures as the MCAP project's own JavaScript reader sees them."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from tests.support import ROOT
from tests.support.commands import command

PACKAGES = ROOT / "build" / "npm"
_PATIENCE = 60  # s

pytestmark = pytest.mark.waits


def read(path: Path) -> dict[str, Any]:
    """What the reader prints of a capture; skips where it is not installed."""
    if shutil.which("node") is None or not (PACKAGES / "node_modules" / "@mcap" / "core").is_dir():
        pytest.skip("no reader in JavaScript: apt-get install nodejs npm, then make packages")
    script = ROOT / "tests" / "support" / "read_mcap.mjs"
    result = subprocess.run(
        ["node", str(script), str(PACKAGES), str(path)],
        capture_output=True,
        timeout=_PATIENCE,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, b"")
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def require_same(path: Path) -> dict[str, Any]:
    """Hold what the reader finds to what ours does; returns that."""
    capture, found = open_capture(path), read(path)
    expected: dict[str, str] = {}
    for chunk in (event for event in capture.events() if isinstance(event, Chunk)):
        topic = f"/{chunk.direction}/raw"
        expected[topic] = expected.get(topic, "") + chunk.data.hex()
    counts = capture.contents.counts
    assert found["raw"] == expected
    assert found["messages"] == {t: n for t, n in counts.items() if n and not t.endswith("/raw")}
    assert found["streamed"] == sum(counts.values())
    assert "bilprov" in found["metadata"]
    return found


@pytest.mark.parametrize("path", sorted((ROOT / "captures" / "samples").glob("*.mcap")))
def test_a_sample_is_read_alike(path: Path) -> None:
    require_same(path)


def test_a_capture_of_the_kit_is_read_alike_with_all_its_topics(tmp_path: Path) -> None:
    sample = min((ROOT / "captures" / "samples").glob("*.mcap"))
    whole, part = tmp_path / "whole.mcap", tmp_path / "part.mcap"
    assert command("capture", "decode", str(sample), str(whole)).returncode == 0
    assert (
        command("capture", "cut", str(whole), str(part), "--filter", "direction == host").returncode
        == 0
    )

    assert require_same(whole)["messages"].keys() >= {"/host/instructions", "/state"}
    assert require_same(part)["raw"]
