"""The bank of faulty devices, generated from the Protocol: each misbehaves in one named way.

Faults are what the suite is tested with. Each says which cases are meant to catch it; a pattern
makes one for each outcome, motion or instruction, a story is written by hand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from conformance.dut.simulator import Fault
from conformance.mutation.faults.answers import answer_faults
from conformance.mutation.faults.codes import code_faults
from conformance.mutation.faults.counts import count_faults
from conformance.mutation.faults.delivery import delivery_faults
from conformance.mutation.faults.history import history_faults
from conformance.mutation.faults.line import line_faults
from conformance.mutation.faults.motion import motion_faults
from conformance.mutation.faults.narrow import narrow_faults
from conformance.mutation.faults.pairs import pair_faults
from conformance.mutation.faults.parsing import parsing_faults
from conformance.mutation.faults.pauses import pause_faults
from conformance.mutation.faults.settings import setting_faults
from conformance.mutation.faults.stops import stop_faults
from conformance.mutation.faults.timing import timing_faults
from spec.protocol import Protocol


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Every named fault that this protocol makes, by name."""
    return {fault.name: fault for fault in all_faults(protocol)}


def all_faults(protocol: Protocol) -> list[Fault]:
    """Every named fault that this protocol makes, family by family."""
    families = (
        answer_faults,
        stop_faults,
        parsing_faults,
        motion_faults,
        setting_faults,
        history_faults,
        line_faults,
        code_faults,
        pair_faults,
        narrow_faults,
        count_faults,
        delivery_faults,
        pause_faults,
        timing_faults,
    )
    return [_with_clauses(fault) for family in families for fault in family(protocol)]


# What a fault of each family breaks, where it does not say it itself.
_CLAUSES = {
    "answer": ("responses", "instructions"),
    "stop": ("safety", "instructions", "responses"),
    "parsing": ("header", "instructions", "responses", "safety"),
    "motion": ("instructions", "safety"),
    "setting": ("instructions", "safety"),
    "history": ("safety", "responses", "instructions"),
    "line": ("header", "responses", "instructions", "safety"),
}


def _with_clauses(fault: Fault) -> Fault:
    return fault if fault.clauses else replace(fault, clauses=_CLAUSES[fault.family])
