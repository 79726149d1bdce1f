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
from bilprov.conformance.mutation.faults import (
    answers,
    corner_cases,
    delivery,
    framing,
    history,
    motion,
    sequences,
)
from bilprov.spec.protocol import Protocol


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Return every named fault of this protocol by name."""
    return {fault.name: fault for fault in all_faults(protocol)}


def all_faults(protocol: Protocol) -> list[Fault]:
    """Return every named fault of this protocol, family by family."""
    groups = (
        answers.answer_faults,
        motion.stop_faults,
        framing.parsing_faults,
        motion.motion_faults,
        motion.setting_faults,
        history.history_faults,
        framing.line_faults,
        answers.code_faults,
        history.power_on_faults,
        sequences.pair_faults,
        corner_cases.narrow_faults,
        history.count_faults,
        delivery.burst_faults,
        delivery.split_faults,
        delivery.time_out_faults,
        framing.data_run_faults,
        delivery.idle_faults,
        motion.timing_faults,
    )
    return [fault for group in groups for fault in group(protocol)]
