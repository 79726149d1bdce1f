"""Finds a device by the name that a user gives, and lists the names there are."""

from __future__ import annotations

from conformance.dut.fault import Fault
from conformance.mutation.faults import fault_bank
from conformance.mutation.random_faults import PREFIX, random_fault
from conformance.mutation.variants import MIXTURE, find_variant, variants
from spec.protocol import Protocol


def find_fault(protocol: Protocol, name: str) -> Fault:
    """The fault, the random fault, the variant or the mixture of that name.

    Raises ValueError, in one sentence, where there is none.
    """
    bank = fault_bank(protocol)
    if name in bank:
        return bank[name]
    if name.startswith(PREFIX):
        seed = name.removeprefix(PREFIX)
        if not seed.isascii() or not seed.isdigit():
            raise ValueError(
                f"there is no fault {name!r}; a random one is {PREFIX}SEED with a whole number, "
                f"for example {PREFIX}7"
            )
        return random_fault(protocol, int(seed))
    if name.startswith(MIXTURE) or "=" in name:
        return find_variant(protocol, name)
    near = [known for known in bank if name and name.split("-")[0] in known][:3]
    hint = f", perhaps {', '.join(near)}" if near else ""
    raise ValueError(f"there is no fault {name!r}{hint}; simulate --list-faults names all")


def listed_faults(protocol: Protocol) -> str:
    """Every named fault with what it does, family by family, as text."""
    families: dict[str, list[Fault]] = {}
    for fault in fault_bank(protocol).values():
        families.setdefault(fault.family, []).append(fault)
    width = max(len(name) for name in fault_bank(protocol))
    lines = []
    for family, faults in families.items():
        lines += ["", f"{family} ({len(faults)})"]
        for fault in faults:
            soak = " (shows in a soak only)" if fault.needs else ""
            lines.append(f"  {fault.name:{width}}  {fault.doc}{soak}")
    drawn = f"{PREFIX}SEED"
    lines += ["", "random", f"  {drawn:{width}}  one that is drawn: when x what, by the seed"]
    return "\n".join(lines[1:])


def listed_variants(protocol: Protocol) -> str:
    """Every legal variant with what it does, then the mixtures, which are faults; as text."""
    from conformance.mutation.mixtures import mixtures

    known = variants(protocol)
    mixed = mixtures(protocol)
    width = max(len(name) for name in known)
    lines = [f"legal variants ({len(known)})"]
    for name, variant in known.items():
        option = f" (needs --allow {variant.allow})" if variant.allow else ""
        lines.append(f"  {name:{width}}  {variant.doc}{option}")
    lines += ["", f"mixtures of two choices, which do not conform ({len(mixed)})"]
    for name, fault in mixed.items():
        lines += [f"  {name}", f"      {fault.doc}"]
    return "\n".join(lines)
