"""Faults that show only after others."""

from __future__ import annotations

from collections.abc import Iterator

from conformance.dut.simulator import Fault
from conformance.mutation.faults.vocabulary import (
    EVERYTHING,
    WATCHED_FAULTS,
    answers_with,
    drives_on,
    when,
)
from spec.protocol import Protocol


def history_faults(protocol: Protocol) -> Iterator[Fault]:
    """What shows only after others."""
    family = "history"
    for count in (10, 100):
        yield Fault(
            f"no-stop-after-{count}-faults",
            family,
            f"after {count} faults it no longer stops for one",
            WATCHED_FAULTS,
            react=when(
                lambda e, count=count: not e.judgement.valid and e.faults >= count,  # type: ignore[misc]
                drives_on,
            ),
        )
    yield Fault(
        "sticks-after-50-faults",
        family,
        "after 50 faults it answers nothing any more",
        EVERYTHING,
        react=when(lambda e: e.faults >= 50, answers_with()),
    )
    yield Fault(
        "every-7th-fault-missed",
        family,
        "drives on after every seventh fault",
        WATCHED_FAULTS,
        react=when(lambda e: not e.judgement.valid and e.faults % 7 == 6, drives_on),
    )
