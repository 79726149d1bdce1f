"""Finds faults, legal variants and mixtures by the name a user gives, and lists all names."""

from __future__ import annotations

from bilprov.conformance.dut.simulator import Fault
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.mutation.random_faults import PREFIX, find_random_fault
from bilprov.conformance.mutation.variants import MIXTURE, mixtures, mixtures_of, variants
from bilprov.spec.protocol import Protocol


def find_fault(protocol: Protocol, name: str) -> Fault:
    """Return the named fault, random fault, legal variant or mixture.

    Raises ValueError, in one sentence, if there is none of that name.
    """
    bank = fault_bank(protocol)
    if name in bank:
        return bank[name]
    if name.startswith(PREFIX):
        return find_random_fault(protocol, name)
    if name.startswith(MIXTURE) or "=" in name:
        return find_variant(protocol, name)
    near = [known for known in bank if name and name.split("-")[0] in known]
    raise ValueError(
        f"there is no fault {name!r}{_perhaps(near)}; simulate --list-faults names all"
    )


def _perhaps(near: list[str]) -> str:
    """A few names that may be meant, in words."""
    return f", perhaps {', '.join(near[:3])}" if near else ""


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
        option = f" (needs --allow {variant.allow})" if variant.allow else ""
        lines.append(f"  {name:{width}}  {variant.doc}{option}")
    lines += ["", f"mixtures of two choices, which do not conform ({len(mixed)})"]
    for name, fault in mixed.items():
        lines += [f"  {name}", f"      {fault.doc}"]
    return "\n".join(lines)


def find_variant(protocol: Protocol, name: str) -> Fault:
    """Return the named legal variant or mixture. Raises ValueError if there is none."""
    known = variants(protocol)
    if name in known:
        return known[name].fault
    if name.startswith(MIXTURE):
        return find_mixture(protocol, name)
    near = [one for one in known if name and name.split("=")[0].lower() in one.lower()]
    raise ValueError(f"there is no variant {name!r}{_perhaps(near)}; see simulate --list-variants")


def find_mixture(protocol: Protocol, name: str) -> Fault:
    """Return the named mixture. Raises ValueError, in one sentence, if there is none."""
    parts = name.removeprefix(MIXTURE).split(":")
    variant = variants(protocol).get(parts[0])
    known = {fault.name: fault for fault in mixtures_of(protocol, variant)} if variant else {}
    if name not in known:
        some = ", ".join(list(known) or list(mixtures(protocol))[:3])
        raise ValueError(f"there is no mixture {name!r}, perhaps {some}")
    return known[name]
