"""Finds faults, legal variants and mixtures by the name a user gives, and lists all names."""

from __future__ import annotations

from difflib import get_close_matches

from bilprov.conformance.dut.simulator import Fault
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.random_faults import PREFIX, find_random_fault
from bilprov.conformance.mutation.variants import MIXTURE, mixtures, variants
from bilprov.spec.protocol import Protocol


def find_fault(protocol: Protocol, name: str) -> Fault:
    """Return the named fault, random fault, legal variant or mixture.

    Raises ValueError, in one sentence, if there is none of that name.
    """
    if name.startswith(PREFIX):
        return find_random_fault(protocol, name)
    if name.startswith(MIXTURE) or "=" in name:
        return find_variant(protocol, name)
    return _named("fault", name, fault_bank(protocol), "simulate --list-faults names all")


def find_variant(protocol: Protocol, name: str) -> Fault:
    """Return the named legal variant or mixture. Raises ValueError if there is none."""
    legal = {known: variant.fault for known, variant in variants(protocol).items()}
    known = legal if name in legal else legal | mixtures(protocol)
    return _named("variant", name, known, "see simulate --list-variants")


def _named(what: str, name: str, known: dict[str, Fault], see: str) -> Fault:
    """Return a fault by its name; names that begin so, or are most alike, may be meant."""
    if name in known:
        return known[name]
    near = [one for one in known if name and one.startswith(name)]
    near = near or get_close_matches(name, known)
    perhaps = f", perhaps {', '.join(near[:3])}" if near else ""
    raise ValueError(f"there is no {what} {name!r}{perhaps}; {see}")


def listed_faults(protocol: Protocol) -> str:
    """Return the text that lists every named fault with what it does, family by family."""
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
    wider = f"{PREFIX}SEED.NUMBER"
    lines += ["", "random", f"  {drawn:{width}}  one that is drawn: when x what, by the seed"]
    lines.append(f"  {wider:{width}}  one of wider families: needles, contexts, rhythms, wheels")
    return "\n".join(lines[1:])


def listed_variants(protocol: Protocol) -> str:
    """Return the text that lists every legal variant and then every mixture (which is a fault)."""
    known = variants(protocol)
    mixed = mixtures(protocol)
    width = max(len(name) for name in known)
    lines = [f"legal variants ({len(known)})"]
    for name, variant in known.items():
        option = f" (needs --allow {variant.row.allow})" if variant.row.allow else ""
        lines.append(f"  {name:{width}}  {variant.row.doc}{option}")
    lines += ["", f"mixtures of two choices, which do not conform ({len(mixed)})"]
    for name, fault in mixed.items():
        lines += [f"  {name}", f"      {fault.doc}"]
    return "\n".join(lines)
