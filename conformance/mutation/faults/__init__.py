"""The bank of faulty devices that the suite is tested with; each misbehaves in one named way.

The faults are generated from the Protocol: some once for each outcome, motion or instruction,
others written by hand. Each fault names the test cases that are meant to catch it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.faults.answers import answer_faults
from bilprov.conformance.mutation.faults.codes import code_faults
from bilprov.conformance.mutation.faults.counts import count_faults, history_faults
from bilprov.conformance.mutation.faults.delivery import delivery_faults
from bilprov.conformance.mutation.faults.line import line_faults
from bilprov.conformance.mutation.faults.motion import motion_faults
from bilprov.conformance.mutation.faults.narrow import narrow_faults
from bilprov.conformance.mutation.faults.pairs import pair_faults
from bilprov.conformance.mutation.faults.parsing import parsing_faults
from bilprov.conformance.mutation.faults.pauses import pause_faults
from bilprov.conformance.mutation.faults.settings import setting_faults
from bilprov.conformance.mutation.faults.stops import stop_faults
from bilprov.conformance.mutation.faults.timing import timing_faults
from bilprov.spec.protocol import Protocol


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Return every named fault of this protocol by name."""
    return {fault.name: fault for fault in all_faults(protocol)}


def all_faults(protocol: Protocol) -> list[Fault]:
    """Return every named fault of this protocol, family by family."""
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


# The clauses that a fault of each family breaks, unless the fault names them itself.
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
