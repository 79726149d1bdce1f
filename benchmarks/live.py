"""Live on ptys: a full line of the protocol's own, and one a hundred times as fast."""

from __future__ import annotations

import sys
from functools import partial

from benchmarks import lines, product
from benchmarks.captures import FAST
from benchmarks.report import OURS, Goal, Row
from benchmarks.setting import Setting, Work
from bilprov.captures.reader import open_capture
from bilprov.captures.topics import DEVICE_RAW, HOST_RAW

_DISTINCT = 2_000_000  # host bytes, after which the traffic is sent again


def _full(
    setting: Setting, work: Work, *, style: str, percent: float, fast: bool, write: bool = True
) -> Row:
    """A line that is full from the host, an answer to each frame: the protocol's own, or a fast.

    The share of a core that `sniff` takes may be so many percent.
    """
    byte_time = FAST if fast else setting.byte_time
    seconds = setting.sizes.fast_line if fast else setting.sizes.line
    baud = "12 Mbaud" if fast else f"{setting.protocol.line.baud:,} baud"
    said = setting.said.first(setting.protocol, _DISTINCT)
    ready = lines.bursts(said, setting.protocol, byte_time)
    share, lost = _ours(setting, ready, seconds, style, write)
    bare_share = _bare(setting, ready, min(seconds, 5.0), write)
    return work.row(
        f"{work.words}, {baud}, {seconds:g} s",
        "% of a core",
        {OURS: share * 100, "bare reader": bare_share * 100},
        Goal(f"at most {percent:g} % of a core", share * 100, percent, at_most=True),
        Goal("no byte lost", lost, 0, at_most=True),
    )


full_line = partial(_full, style="jsonl", percent=6, fast=False, write=False)
full_line_written = partial(_full, style="jsonl", percent=10, fast=False)
full_line_on_screen = partial(_full, style="live", percent=15, fast=False)
fast_line = partial(_full, style="quiet", percent=40, fast=True)
fast_line_on_screen = partial(_full, style="live", percent=60, fast=True)


def _ours(
    setting: Setting, ready: lines.Bursts, seconds: float, style: str, write: bool
) -> tuple[float, int]:
    """The share of a core, and the bytes lost."""
    capture = setting.new_file("live.mcap") if write else None
    out = setting.new_file("live.out")
    with lines.wires() as on, lines.screen() as screen, out.open("xb") as file:
        words = product.sniffed(on.host.name, on.device.name, style, capture)
        output = screen if style == "live" else file
        heard = lines.listen(words, on, ready, seconds, output, screen)
    if not capture:
        return heard.share, heard.sent - lines.shown(out)
    sizes = open_capture(capture).contents.sizes
    return heard.share, heard.sent - sizes.get(HOST_RAW, 0) - sizes.get(DEVICE_RAW, 0)


def _bare(setting: Setting, ready: lines.Bursts, seconds: float, write: bool) -> float:
    """The share of a core that the bare reader takes."""
    log, out = setting.new_file("bare.raw"), setting.new_file("bare.out")
    more = ["--write", str(log)] if write else []
    with lines.wires() as on, lines.screen() as screen, out.open("xb") as file:
        words = [sys.executable, "-m", "benchmarks.bare_reader", on.host.name, on.device.name]
        return lines.listen([*words, *more], on, ready, seconds, file, screen).share
