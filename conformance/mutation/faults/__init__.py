"""The bank of faulty devices that the suite is tested with; each misbehaves in one named way.

The faults are generated from the Protocol: some once for each outcome, motion or instruction,
others written by hand. Each fault names the test cases that are meant to catch it.

To add a fault, add a row to the function of its subject, for example in `answers.py`::

    yield answer_fault("double-answer-to-faults", "answers faulty instructions twice",
                       when(faulty, twice))

A row is a name, a description and the reaction: `when` some frames come (a trigger), what the
device does (an effect). `vocabulary.py` has the triggers and effects; what the row does not say,
the clauses that it breaks and the cases that catch it, is its family's (`family.py`).
"""

from __future__ import annotations

from functools import cache

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.faults.answers import answer_faults, code_faults
from bilprov.conformance.mutation.faults.corner_cases import narrow_faults
from bilprov.conformance.mutation.faults.delivery import (
    burst_faults,
    idle_faults,
    split_faults,
    time_out_faults,
)
from bilprov.conformance.mutation.faults.framing import (
    data_run_faults,
    line_faults,
    parsing_faults,
)
from bilprov.conformance.mutation.faults.history import (
    count_faults,
    history_faults,
    power_on_faults,
)
from bilprov.conformance.mutation.faults.motion import motion_faults, setting_faults, stop_faults
from bilprov.conformance.mutation.faults.sequences import pair_faults
from bilprov.conformance.mutation.faults.timing import timing_faults
from bilprov.spec.protocol import Protocol


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Return every named fault of this protocol by name."""
    return {fault.name: fault for fault in all_faults(protocol)}


def all_faults(protocol: Protocol) -> list[Fault]:
    """Return every named fault of this protocol, family by family."""
    groups = (
        answer_faults,
        stop_faults,
        parsing_faults,
        motion_faults,
        setting_faults,
        history_faults,
        line_faults,
        code_faults,
        power_on_faults,
        pair_faults,
        narrow_faults,
        count_faults,
        burst_faults,
        split_faults,
        time_out_faults,
        data_run_faults,
        idle_faults,
        timing_faults,
    )
    return [fault for group in groups for fault in group(protocol)]
