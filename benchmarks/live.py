"""Live on ptys: a full line of the protocol's own, and one a hundred times as fast."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

from benchmarks import lines, product
from benchmarks.captures import FAST
from benchmarks.commands import bilprov_words
from benchmarks.report import Goal, Row
from benchmarks.setting import Setting, Work

_BARE = "bare reader"
_DISTINCT = 2_000_000  # host bytes, after which the traffic is sent again
_BARE_SECONDS = 5.0


class _Line(NamedTuple):
    """How fast a line is, in ns a byte and in words, and for how many seconds it is full."""

    byte_time: int
    words: str
    seconds: float


def full_line(setting: Setting, work: Work, *, style: str, write: bool, percent: float) -> Row:
    """The protocol's own line, full from the host, an answer to each frame."""
    line = _Line(setting.byte_time, f"{setting.protocol.line.baud:,} baud", setting.sizes.line)
    return _row(setting, work, line, style, write, percent)


def fast_line(setting: Setting, work: Work, *, style: str, percent: float) -> Row:
    """12 Mbaud, full from the host, an answer to each frame; everything is logged."""
    return _row(setting, work, _Line(FAST, "12 Mbaud", setting.seconds), style, True, percent)


def _row(
    setting: Setting,
    work: Work,
    line: _Line,
    style: str,
    write: bool,
    percent: float,
) -> Row:
    said = setting.said.first(setting.protocol, _DISTINCT)
    ready = lines.bursts(said, setting.protocol, line.byte_time)
    share, lost, late = _ours(setting, ready, line.seconds, style, write)
    bare_seconds = min(line.seconds, _BARE_SECONDS)
    bare_share, bare_lost = _bare(setting, ready, bare_seconds, write)
    return Row(
        work.name,
        f"{work.words}, {line.words}, {line.seconds:g} s",
        "% of a core",
        share * 100,
        {_BARE: bare_share * 100},
        {"B lost": float(lost)} | ({"B of them found no room": float(late)} if late else {}),
        {"B lost": bare_lost},
        (
            Goal(f"at most {percent:g} % of a core", share * 100, percent, at_most=True),
            Goal("no byte lost", lost, 0, at_most=True),
        ),
    )


def _ours(
    setting: Setting, ready: lines.Bursts, seconds: float, style: str, write: bool
) -> tuple[float, int, int]:
    """The share of a core, the bytes lost in all, and those that found no room on the line."""
    capture = setting.new_file("live.mcap") if write else None
    out = setting.new_file("live.out")
    with lines.wires() as on, lines.screen() as screen, out.open("xb") as file:
        words = bilprov_words(*product.sniffed(on.host.name, on.device.name, style, capture))
        output = screen if style == "live" else file
        heard = lines.listen(words, on, ready, seconds, output, screen)
    got = product.captured(capture) if capture else lines.shown(out)
    return heard.share, _missing(heard.sent, sum(got.values())), heard.sent.lost


def _bare(setting: Setting, ready: lines.Bursts, seconds: float, write: bool) -> tuple[float, int]:
    log, out = setting.new_file("bare.raw"), setting.new_file("bare.out")
    more = ["--write", str(log)] if write else []
    with lines.wires() as on, lines.screen() as screen, out.open("xb") as file:
        words = [sys.executable, "-m", "benchmarks.bare_reader", on.host.name, on.device.name]
        heard = lines.listen([*words, *more], on, ready, seconds, file, screen)
    got = _size(log) if write else sum(lines.shown(out).values())
    return heard.share, _missing(heard.sent, got)


def _missing(sent: lines.Sent, got: int) -> int:
    return sent.host + sent.device - got


def _size(path: Path) -> int:
    return path.stat().st_size
