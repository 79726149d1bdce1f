"""The kinds of anomalies of a stretch's rows, found from one record of each sort of rows."""

from __future__ import annotations

from collections import Counter
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
    for place in range(len(OUTCOMES)):
        with_it = verdict == place
        if not with_it.any():
            continue
        row = stretch.carried + int(np.argmax(with_it))
        (frame,) = stretch.frame_bytes(np.array([row]))
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
    # In order, as `answers` takes them.
    order = np.argsort(first)
    kinds: list[tuple[str, ...]] = [()] * (len(first) + 1)
    for sort_place, answer in zip(order.tolist(), stretch.answers(odd[first[order]]), strict=True):
        kinds[1 + sort_place] = _serious(stretch.device_record(answer, stretch.before))
    return Kinds(code, kinds)


def fault_counts(stretch: Stretch) -> Counter[str]:
    """The number of anomalies by kind, without those of severity info and of line events."""
    counts: Counter[str] = Counter()
    for found in (host_kinds(stretch), device_kinds(stretch)):
        if any(found.kinds):
            amounts = np.bincount(found.code, minlength=len(found.kinds)).tolist()
            for kinds, amount in zip(found.kinds, amounts, strict=True):
                for kind in kinds if amount else ():
                    counts[kind] += amount
    return counts


def _serious(record: Record) -> tuple[str, ...]:
    return tuple(fault.kind for fault in serious_faults(record))
