"""Live on ptys: a full line of the protocol's own, and one a hundred times as fast."""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks import lines, product
from benchmarks.captures import FAST
from benchmarks.commands import bilprov_words
from benchmarks.report import Goal, Row
from benchmarks.setting import Setting, Work

_BARE = "bare reader"
_DISTINCT = 100_000  # host bytes, after which the traffic is sent again
_BARE_SECONDS = 5.0


def full_line(setting: Setting, work: Work, *, style: str, write: bool, percent: float) -> Row:
    """The protocol's own line, full from the host, an answer to each frame."""
    seconds = setting.sizes.line
    return _row(setting, work, setting.byte_time, seconds, style, write, percent)


def fast_line(setting: Setting, work: Work, *, style: str, percent: float) -> Row:
    """12 Mbaud, full from the host, an answer to each frame; everything is logged."""
    return _row(setting, work, FAST, setting.seconds, style, True, percent)


def _row(
    setting: Setting,
    work: Work,
    byte_time: float,
    seconds: float,
    style: str,
    write: bool,
    percent: float,
) -> Row:
    said = setting.said.first(setting.protocol, _DISTINCT if byte_time != FAST else 20 * _DISTINCT)
    ready = lines.bursts(said, setting.protocol, byte_time)
    share, lost, late = _ours(setting, ready, seconds, style, write)
    bare_seconds = min(seconds, _BARE_SECONDS)
    bare_share, bare_lost = _bare(setting, ready, bare_seconds, write)
    return Row(
        work.name,
        f"{work.words}, {round(1e10 / byte_time):,} baud, {seconds:g} s",
        "% of a core",
        share * 100,
        {_BARE: bare_share * 100},
        {"B lost": lost, "B refused by the line": late, f"B lost by the {_BARE}": bare_lost},
        (
            Goal(f"at most {percent:g} % of a core", share * 100, percent, at_most=True),
            Goal("no byte lost", lost, 0, at_most=True),
        ),
    )


def _ours(
    setting: Setting, ready: list[lines.Burst], seconds: float, style: str, write: bool
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


def _bare(
    setting: Setting, ready: list[lines.Burst], seconds: float, write: bool
) -> tuple[float, int]:
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
