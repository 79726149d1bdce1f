"""Bytes to columns and to records, beside construct interpreted and the C loop."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable

from benchmarks import product
from benchmarks.ceiling import Judged
from benchmarks.commands import medians, run, timed
from benchmarks.report import C_LOOP, CONSTRUCT, OURS, Row, times
from benchmarks.setting import Setting, Work
from benchmarks.traffic import Traffic


class Disagree(Exception):
    """Raised where two decoders do not say the same of the same bytes: no figure counts then."""


def columns(setting: Setting, work: Work) -> Row:
    """Host bytes to a verdict and a state for each frame."""
    decode, said = product.decoded_columns(setting.protocol), setting.said

    def judged(data: bytes) -> Judged:
        return product.judged_columns(decode(data), setting.protocol)

    if judged(said.host).codes != said.device:
        raise Disagree("the columns' verdicts are not those of the frames that were drawn")
    few = setting.sample.host
    _require_same("columns", judged(few), CONSTRUCT, setting.construct.judged(few))
    _require_same("columns", judged(said.host), C_LOOP, setting.ceiling.judged(said.host))
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
    expected = setting.ceiling.judged(said.host).summary()

    def ours() -> float:
        told = run([sys.executable, "-m", "benchmarks.product", str(file)], keep=True)
        took, judged = json.loads(told.output)
        if judged != expected:
            raise Disagree(f"records: {judged}; {C_LOOP}: {expected}")
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


def _require_same(one: str, judged: Judged, other: str, also: Judged) -> None:
    if judged.summary() != also.summary():
        raise Disagree(f"{one}: {judged.summary()}; {other}: {also.summary()}")
