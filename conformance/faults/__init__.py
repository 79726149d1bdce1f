"""The bank of faulty devices, generated from the Protocol: each misbehaves in one named way.

Faults are what the suite is tested with. Each says which cases are meant to catch it; a pattern
makes one for each outcome, motion or instruction, a story is written by hand.
"""

from __future__ import annotations

from functools import cache

from conformance.faults.answers import answer_faults
from conformance.faults.history import history_faults
from conformance.faults.lines import line_faults
from conformance.faults.motion import motion_faults
from conformance.faults.parsing import parsing_faults
from conformance.faults.settings import setting_faults
from conformance.faults.stops import stop_faults
from conformance.simulator import Fault
from spec.protocol import Protocol


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Every named fault that this protocol makes, by name."""
    families = (
        answer_faults,
        stop_faults,
        parsing_faults,
        motion_faults,
        setting_faults,
        history_faults,
        line_faults,
    )
    return {fault.name: fault for family in families for fault in family(protocol)}
