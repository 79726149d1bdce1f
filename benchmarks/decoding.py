"""Bytes to columns and to records, beside construct interpreted and the C loop."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable

from benchmarks import product
from benchmarks.commands import medians, run, timed
from benchmarks.report import C_LOOP, CONSTRUCT, OURS, Row, times
from benchmarks.setting import Setting, Work
from benchmarks.traffic import Traffic


class Disagree(Exception):
    """Raised where a decoder gives other verdicts than were drawn: no figure counts then."""


def columns(setting: Setting, work: Work) -> Row:
    """Host bytes to a verdict and a state for each frame."""
    decode, said = product.decoded_columns(setting.protocol), setting.said

    _require("columns", said, product.judged_columns(decode(said.host), setting.protocol))
    _require(C_LOOP, said, setting.ceiling.judged(said.host))
    frames = setting.construct.frames(setting.sample.host)
    _require(CONSTRUCT, setting.sample, bytes(frame.code for frame in frames))
    works = {OURS: lambda: said.frames / timed(lambda: decode(said.host)), **_peers(setting, said)}
    rates = medians(setting.sizes.rounds, works)
    least = {CONSTRUCT: 400, C_LOOP: 0.12}
    goals = [times(rates, name, least[name]) for name in rates if name != OURS]
    return work.row(_with_size(work, said), "frames/s", rates, *goals)


def records(setting: Setting, work: Work) -> Row:
    """Host bytes to a list of records, one by one: the first call in a process of its own."""
    file = setting.new_file("records.bytes")
    said = setting.said.first(setting.protocol, setting.sizes.records)
    file.write_bytes(said.host)

    def ours() -> float:
        told = run([sys.executable, "-m", "benchmarks.product", str(file)], keep=True)
        took, codes = json.loads(told.output)
        _require("records", said, bytes.fromhex(codes))
        return said.frames / float(took)

    rates = medians(min(3, setting.sizes.rounds), {OURS: ours, **_peers(setting, said)})
    return work.row(_with_size(work, said), "frames/s", rates, times(rates, CONSTRUCT, 40))


def _with_size(work: Work, said: Traffic) -> str:
    return f"{work.words}, {len(said.host) / 1e6:.3g} MB"


def _peers(setting: Setting, said: Traffic) -> dict[str, Callable[[], float]]:
    """Frames/s of construct on the sample, and of the C loop on all of it."""
    sample = [frame.data for frame in setting.construct.frames(setting.sample.host)]
    return {
        CONSTRUCT: lambda: len(sample) / timed(lambda: setting.construct.parse(sample)),
        C_LOOP: lambda: said.frames / timed(lambda: setting.ceiling.decode(said.host)),
    }


def _require(who: str, said: Traffic, codes: bytes) -> None:
    if codes != said.device:
        raise Disagree(f"the verdicts of {who} are not those of the frames that were drawn")
