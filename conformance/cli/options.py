"""The device that `--fault` or `--variant` names."""

from __future__ import annotations

import rich_click as click

from conformance.dut.simulator import Fault
from conformance.mutation.catalogue import find_fault
from conformance.mutation.variants import find_variant
from spec.protocol import Protocol


def named_device(protocol: Protocol, fault: str | None, variant: str | None) -> Fault | None:
    """What `--fault` or `--variant` names, None for neither. Raises UsageError, in one sentence."""
    if fault is not None and variant is not None:
        raise click.UsageError("--fault and --variant are two devices: give one of them")
    try:
        if variant is not None:
            return find_variant(protocol, variant)
        return None if fault is None else find_fault(protocol, fault)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
