"""Shows the findings of the passive judge: a table on standard error, or one JSON object.

The object is the last line of `--format jsonl` and has `kind` "judgement". Its other keys:
`exit` (1 if there was a violation, else 3 where a recording was not judged to its end or no
instruction could be judged, else 0),
`instructions`, `judged` (those whose answer was judged),
`looks`, `unread` (for how many ns nothing was read),
`not_judged` (how many for which reason), `coverage` (each `clause`, `what`, `done` out of
`of`), `violations` (how many of each kind), `readings` (how often another legal reading was met, or
what is odd but legal), `stopped` (whether a recording was not judged to its end), and `listed`: the
first 20 violations, each `t` (s since the start), `kind`, `clause`, `reading`,
`reason`, `instruction` (its sequence).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import msgspec

from bilprov.analyzer.monitor.passive_judge import Findings
from bilprov.analyzer.output.outputs import Format
from bilprov.captures.text import quantity


def tell_findings(findings: Findings, style: Format) -> int:
    """Show the findings in the format of the session's output, and return the exit code."""
    if style == "jsonl":
        sys.stdout.write(msgspec.json.encode(as_json(findings)).decode() + "\n")
        sys.stdout.flush()
    else:
        _draw(findings)
    return findings.exit


def as_json(findings: Findings) -> dict[str, Any]:
    """The findings as a JSON object; the module's docstring explains the keys."""
    told = {"kind": "judgement", "exit": findings.exit, **msgspec.to_builtins(findings)}
    listed = [msgspec.to_builtins(v) | {"t": v.t / 1e9} for v in findings.listed]
    return told | {"listed": listed}


def sentences(findings: Findings) -> Iterator[str]:
    """The findings in words: what was judged, what was not, what contradicts the document."""
    yield f"judged {findings.judged} of {quantity(findings.instructions, 'instruction')}" + (
        f" and {quantity(findings.looks, 'observation')} after a fault" if findings.looks else ""
    )
    if findings.unread:
        yield f"not observed: {findings.unread / 1e9:.1f} s, in which nothing was read"
    for reason, count in findings.not_judged.items():
        yield f"not judged: {count} ({reason})"
    if findings.stopped:
        yield "not judged: the rest of the recording, because the replay was stopped"
    for reading, count in findings.readings.items():
        what = "another legal reading of" if reading.startswith("R-") else "legal, but"
        yield f"{what} {reading}: {count}"
    for one in findings.listed:
        rests_on = f"{one.clause}, {one.reading}" if one.reading else one.clause
        yield f"violation at {one.t / 1e9:.3f} s: {one.kind}: {one.reason} ({rests_on})"
    total = sum(findings.violations.values())
    if total > len(findings.listed):
        yield f"and {total - len(findings.listed)} more violations"
    kinds = ", ".join(f"{count} {kind}" for kind, count in findings.violations.items())
    fine = "no violation was seen" if findings.judged else "nothing could be judged"
    several = "violation" if total == 1 else "violations"
    yield f"{total} {several}: {kinds}" if total else fine


def _draw(findings: Findings) -> None:
    # Standard error may be a pipe, so lines are never cut.
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
    drawn = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("clause", "covered", "done", "of"):
        drawn.add_column(name, justify="right" if name in ("done", "of") else "left", no_wrap=True)
    for row in findings.coverage:
        cells = (row.clause, row.what, str(row.done), str(row.of))
        drawn.add_row(*map(Text, cells), style="" if row.done else "dim")
    console.print(drawn)
    for sentence in sentences(findings):
        console.print(Text(sentence), style="red" if sentence.startswith("violation") else "")
