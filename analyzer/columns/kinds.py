"""The kinds of anomalies of a stretch's rows, found from one record of each sort of rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bilprov.analyzer.columns.stretch import Stretch
from bilprov.analyzer.decode.records import HostRecord, Record, serious_faults
from bilprov.spec.tables import OUTCOMES


class Kinds(NamedTuple):
    """Each row's place in `kinds`, which has the kinds of its anomalies without those of info."""

    code: NDArray[np.integer]
    kinds: list[tuple[str, ...]]


def host_kinds(stretch: Stretch) -> Kinds:
    """The kinds of the new host rows; the verdict decides them."""
    verdict = stretch.new.verdict
    kinds: list[tuple[str, ...]] = [()] * len(OUTCOMES)
    for place in np.flatnonzero(np.bincount(verdict)).tolist():
        frame = stretch.frame(stretch.carried + int(np.argmax(verdict == place)))
        judgement = stretch.decoding.steps[frame].judgement
        # Neither times nor the state matter here; the states of a stretch need not be worked out.
        kinds[place] = _serious(
            HostRecord(0, 0, 0, "instruction", frame, judgement, 0, stretch.before)
        )
    return Kinds(verdict, kinds)


def device_kinds(stretch: Stretch) -> Kinds:
    """The kinds of the device rows; byte, verdict of the instruction and lateness decide them."""
    odd = np.flatnonzero(~stretch.fits)
    sort = stretch.byte[odd].astype(np.int64)
    if stretch.decoding.paired:
        late = stretch.latency[odd] > stretch.decoding.late
        sort += stretch.frames.verdict[odd].astype(np.int64) << 8
        sort += late.astype(np.int64) << 16
    _, first, place = np.unique(sort, return_index=True, return_inverse=True)
    code = np.zeros(len(stretch.byte), np.int64)
    code[odd] = 1 + place
    records = (
        next(stretch.device_records(row, row + 1, stretch.carried)) for row in odd[first].tolist()
    )
    return Kinds(code, [(), *map(_serious, records)])


def _serious(record: Record) -> tuple[str, ...]:
    return tuple(fault.kind for fault in serious_faults(record))
