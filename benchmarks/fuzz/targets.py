"""The table of all targets."""

from __future__ import annotations

from benchmarks.fuzz import captures, editing, reports, text_files, traffic, typed
from benchmarks.fuzz.engine import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (traffic, typed, text_files, captures, editing, reports)
    for target in module.TARGETS
}
"""Every target by its name."""
