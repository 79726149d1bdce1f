"""Finds faults and variants by the name a user gives, lists all names, and draws random faults."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any, NamedTuple, TypeVar

from bilprov.conformance.dut.simulator import Fault
from bilprov.conformance.mutation import faults
from bilprov.conformance.mutation.triggers import TRUNCATED, trigger
from bilprov.spec.by_effect import variable_of
from bilprov.spec.protocol import InstructionSpec, Protocol

# -- random faults: triggers and effects of the vocabulary, crossed -------------------------------
# `random:SEED` is a frame, up to two conditions (state, data, history, timing) and an effect.
# `random:SEED.NUMBER` draws from wider families: also a value in the data of frames that are
# already faulty (needle), frames right after others or in a state (context), every n-th frame of
# a class (rhythm), settings in which the robot does not obey, and wheels that turn at another
# speed. No reading of the document allows any of the effects.


T = TypeVar("T")


class Draw:
    """Random draws, made with `random()` alone because only it is the same in every Python."""

    def __init__(self, seed: int | str) -> None:
        self._next = random.Random(seed).random

    def below(self, end: int) -> int:
        """Return a whole number from 0 to `end` - 1."""
        return int(self._next() * end)

    def pick(self, choices: Sequence[T]) -> T:
        """Return one of the choices."""
        return choices[self.below(len(choices))]

    def between(self, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`, both included."""
        return low + self.below(high - low + 1)


PREFIX = "random:"
_LEAST = 32  # a difference of wheels at a smaller speed or strength is none that a suite must see
_PLACES = ("first-byte", "last-byte", "second-byte")

_DRAWN = {
    name: tuple(template for template, often in rows.items() for _ in range(often))
    for name, rows in faults.table("random.toml", dict[str, dict[str, int]]).items()
}
"""The templates of each kind; one that stands several times is drawn more often."""


def _pools(protocol: Protocol) -> dict[str, Sequence[Any]]:
    """Return what the placeholders of templates are drawn from."""
    known, tops = faults.names(protocol), faults.names(protocol)["top"]
    longest = protocol.data_lengths[-1]
    wrong = {
        (spec.id, f"outcome {'too-many' if n > spec.length else 'too-few'}, length {n}"): None
        for spec in protocol.instructions
        for n in protocol.data_lengths[1:]
        if n != spec.length
    }
    low, high = protocol.limits.get(protocol.car.steering, (0, 0))
    return {
        "instruction": [spec.name for spec in protocol.instructions],
        "outcome": known["outcomes"],
        "motion": known["motions"],
        "unused": protocol.unused_ids,
        "known": list(protocol.by_id),
        "length": protocol.data_lengths,
        "data length": protocol.data_lengths[1:],
        "cut": range(2, min(4, longest) + 1),
        "wrong length": list(dict.fromkeys(when for _, when in wrong)),
        "wrong length of an ID": [f"{when}, id {identity}" for identity, when in wrong],
        "side": ["steering > 0"] * (high > 0) + ["steering < 0"] * (low < 0),
        "speed": range(1, tops.get("speed", 0) + 1),
        "fast": range(_LEAST, tops.get("speed", 0) + 1),
        "strong": range(_LEAST, high + 1),
        "byte": (0, 1, 127, 128, 255, *(1 << bit for bit in range(1, 7))),
        "bit": [1 << bit for bit in range(8)],
        "gap": (15, 30, 60),
        "period": (64, 100, 256, 1000),
        "code": [code for code in range(256) if code not in protocol.codes],
        "own code": list(protocol.codes),
        "late": [known["late_answer"]],
        "late stop": [known["late_stop"]],
        **{
            f"bit of {name}": [1 << bit for bit in range(top.bit_length())]
            for name, top in tops.items()
        },
    }


class Frames(NamedTuple):
    """The frames of a fault: their terms, the instruction of valid ones, the fault of others.

    `outcome` is "" for any fault. `narrow` is true where any value of 256 besides would make them
    too few to be met: where both ID and length are given, or each takes a time-out.
    """

    when: str
    spec: InstructionSpec | None
    outcome: str
    narrow: bool


class Drawn(NamedTuple):
    """A fault that is drawn: its family, terms and effect."""

    family: str
    when: Sequence[str]
    what: str


class FaultDraw:
    """Draws faults of one protocol from one seed."""

    def __init__(self, protocol: Protocol, seed: int | str) -> None:
        self._protocol = protocol
        self._draw = Draw(seed)
        self._pools = {name: pool for name, pool in _pools(protocol).items() if pool}

    def wide(self) -> Drawn:
        """Draw a fault of any family."""
        families = (
            *8 * (self.simple,),
            *4 * (self.needle,),
            *3 * (self.in_context,),
            *3 * (self.rhythm,),
            *(self.disobedience, self.wheels_astray),
        )
        return self._draw.pick(families)()

    def simple(self) -> Drawn:
        """Draw a frame, up to two conditions, and an effect."""
        frames = self._frames(*_DRAWN["frames"])
        spec = frames.spec
        timing = (
            (*_DRAWN["timing"], "pause > 1") if spec is None or spec.length else _DRAWN["timing"]
        )
        kinds: list[Sequence[str]] = [_DRAWN["states"], _DRAWN["states"], _DRAWN["history"], timing]
        kinds += 3 * [self._data(frames)] if frames.outcome != TRUNCATED else []
        terms = [frames.when]
        for _ in range(self._draw.pick((0, 1, 1, 1, 1, 2))):
            kind = self._draw.pick([kind for kind in kinds if kind])
            kinds = [other for other in kinds if other is not kind]
            terms.append(self._one(*kind))
        return Drawn("random", terms, self._effect(frames))

    def needle(self) -> Drawn:
        """Draw a value in the data of faulty frames, sometimes in one state only."""
        frames = self._frames(*_DRAWN["faulty-frames"])
        terms = [frames.when, self._byte(frames, "{byte}" if frames.narrow else "{0 255}")]
        if not frames.narrow and self._draw.below(3) == 0:
            terms.append(self._one(*_DRAWN["states"]))
        return Drawn("random needle", terms, self._effect(frames, in_silence=False))

    def in_context(self) -> Drawn:
        """Draw a frame, a value in it, and the frame before or the state."""
        draw = self._draw
        carriers = [spec for spec in self._protocol.instructions if spec.fields]
        in_state = draw.below(5) == 0  # where any value is met often enough; elsewhere one of a few
        if carriers and draw.below(2):
            spec = draw.pick(carriers)
            low, high = spec.fields[0].low, spec.fields[0].high
            some = [value for value in self._pools["byte"] if low <= value <= high]
            frames = self._frames(f"instruction {spec.name}")
            values = range(low, high + 1) if in_state or not some else some
            terms = [frames.when, f"value {draw.pick(values)}"]
        else:
            frames = self._frames(*_DRAWN["faulty-frames"])
            terms = [frames.when]
            if not frames.narrow:
                terms.append(self._byte(frames, "{0 255}" if in_state else "{byte}"))
        terms.append(self._one(*(_DRAWN["states"] if in_state else _DRAWN["right-after"])))
        return Drawn("random context", terms, self._effect(frames, in_silence=False))

    def rhythm(self) -> Drawn:
        """Draw every n-th frame, fault, or frame of a class, sometimes in one state."""
        frames, times = self._frames(*_DRAWN["counted"]), self._one(*_DRAWN["rhythm"])
        states = [self._one(*_DRAWN["states"])] if self._draw.below(3) == 0 else []
        # counted in any state, or in this one
        terms = [times, *states] if self._draw.below(2) else [*states, times]
        effects = [self._one(*_DRAWN["at-times"])] * 5
        if frames.spec or frames.outcome:
            effects.append(self._effect(frames, in_silence=False))
        return Drawn("random rhythm", [frames.when, *terms], self._draw.pick(effects))

    def disobedience(self) -> Drawn:
        """Draw settings in which instructions are answered and not carried out."""
        settings = [one for one in _DRAWN["settings"] if self._can(one)]
        if not settings:
            return self.simple()
        specs = self._protocol.instructions
        moves = self._protocol.car.moves
        some = [[s.name for s in specs if moves(s.effect) is moving] for moving in (True, False)]
        frames = ["valid", *(f"instruction {' '.join(them)}" for them in some if them)]
        terms = [self._draw.pick(frames), self._one(*settings)]
        return Drawn("random settings", terms, "drives-on")

    def wheels_astray(self) -> Drawn:
        """Draw wheels that turn slower, or backwards, from a speed or a strength on."""
        some = [one for one in _DRAWN["wheels"] if self._can(one)]
        return Drawn("random wheels", [], self._one(*some)) if some else self.simple()

    def _can(self, template: str) -> bool:
        """Return whether the protocol has what the template draws from."""
        drawn = re.findall(r"{([^}]+)}", template)
        return all(name in self._pools or name[0].isdigit() for name in drawn)

    def _one(self, *templates: str) -> str:
        """Draw one of the templates that the protocol can fill, and fill it."""

        def drawn(match: re.Match[str]) -> str:
            name = match[1]
            if name in self._pools:
                return str(self._draw.pick(self._pools[name]))
            low, high = map(int, name.split())
            return str(self._draw.between(low, high))

        possible = [template for template in templates if self._can(template)]
        return re.sub(r"{([^}]+)}", drawn, self._draw.pick(possible))

    def _frames(self, *templates: str) -> Frames:
        """Draw frames."""
        when = self._one(*templates)
        terms = {term.subject: term.values for term in trigger(when).terms}
        (name,) = terms.get("instruction", ("",))
        (outcome,) = terms.get("outcome", (TRUNCATED if TRUNCATED in terms else "",))
        if list(terms) == ["id"]:
            outcome = "unknown-id"
        narrow = TRUNCATED in terms or {"id", "length"} <= terms.keys()
        return Frames(when, self._protocol.by_name.get(name), outcome, narrow)

    def _data(self, frames: Frames) -> Sequence[str]:
        """Return templates of data: a value, a threshold, a bit; or what a header announces."""
        if frames.outcome == "bad-data":
            return ("value & {bit}",)
        if frames.spec is None:
            return _DRAWN["lengths"]
        for part in frames.spec.fields[:1]:
            bit = 1 << self._draw.below(max(1, part.high.bit_length()))
            span = f"{{{part.low} {part.high}}}"
            return (f"value {span}", f"value >= {span}", f"value & {bit}", f"value !& {bit}")
        return ()

    def _byte(self, frames: Frames, value: str) -> str:
        """Draw a data byte and a value, a threshold or a bit of it."""
        one_byte = re.search(r"length 1\b|size 2\b", frames.when)
        place = self._draw.pick(_PLACES[:2] if one_byte else _PLACES)
        return f"{place} {self._one(*_DRAWN['byte'], value, value)}"

    def _effect(self, frames: Frames, *, in_silence: bool = True) -> str:
        """Draw an effect on such frames.

        Without `in_silence` those are left out that show only where nothing is sent after the
        frame: a trigger that many frames must meet would take a silence after each.
        """
        found = [*_DRAWN["answer"], "answers-again 12" if in_silence else "twice 12"]
        spec, outcome = frames.spec, frames.outcome
        if spec or outcome not in ("", TRUNCATED):  # silence there is legal
            found.append("silent")
        if spec is None:
            found += [*3 * ["drives-on"], "stops-after {late stop}", "answers-as valid"]
            found += [f"resumes-after {pause}" for pause in (12, 60, 120)] * in_silence
            found += ["turns-bits led {bit of led}", "turns-bits speed {bit of speed}"]
            if outcome:
                bad = outcome in (TRUNCATED, "unknown-id")
                found.append(f"answers-as {'bad-data' if bad else 'unknown-id'}")
            return self._one(*found)
        found.append("answers-as {outcome}")
        if self._protocol.stops(spec.effect):
            found += 2 * ["drives-on", *["resumes-after 15"] * in_silence]
            found.append("turns-bits led {bit of led}")
        elif spec.effect.assignments:
            own = self._protocol.role_of[variable_of(spec)]
            moves = self._protocol.car.moves(spec.effect)
            found += 3 * ["drives-on"]
            found += ["stands-still"] * (own != "motion") + ["sets motion {motion}"] * moves
            strayed = (own, own, "speed", "led", *["steering"] * (own != "motion"))
            found += [f"turns-bits {name} {{bit of {name}}}" for name in strayed]
        return self._one(*found)


@cache
def find_random_fault(protocol: Protocol, name: str) -> Fault:
    """Return the random fault of that name. Raises ValueError, in one sentence, for any other."""
    parts = name.removeprefix(PREFIX).split(".")
    numbers = [int(part) for part in parts if part.isascii() and part.isdigit()]
    seed = ".".join(map(str, numbers))
    if len(numbers) == len(parts) == 1:
        drawn = FaultDraw(protocol, numbers[0]).simple()
    elif len(numbers) == len(parts) == 2:
        drawn = FaultDraw(protocol, seed).wide()
    else:
        raise ValueError(
            f"there is no fault {name!r}; a random one is {PREFIX}SEED or {PREFIX}SEED.NUMBER, "
            f"each a whole number, for example {PREFIX}7 or {PREFIX}7.1"
        )
    when = ", ".join(term for term in drawn.when if term)
    doc = f"{when or 'always'}: {drawn.what}"
    clauses = ("safety", "responses", "instructions", "header")
    made = faults.hooks(protocol, faults.Row(doc, drawn.what, when))
    return Fault(f"{PREFIX}{seed}", drawn.family, doc, ("*",), clauses=clauses, **made)


def find_fault(protocol: Protocol, name: str) -> Fault:
    """Return the named fault, random fault, legal variant or mixture.

    Raises ValueError, in one sentence, if there is none of that name.
    """
    if name.startswith(PREFIX):
        return find_random_fault(protocol, name)
    if name.startswith(faults.MIXTURE) or "=" in name:
        return find_variant(protocol, name)
    return _named("fault", name, faults.fault_bank(protocol), "simulate --list-faults names all")


def find_variant(protocol: Protocol, name: str) -> Fault:
    """Return the named legal variant or mixture. Raises ValueError if there is none."""
    legal = {known: variant.fault for known, variant in faults.variants(protocol).items()}
    known = legal if name in legal else legal | faults.mixtures(protocol)
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
    for fault in faults.fault_bank(protocol).values():
        families.setdefault(fault.family, []).append(fault)
    width = max(len(name) for name in faults.fault_bank(protocol))
    lines = []
    for family, its in families.items():
        lines += ["", f"{family} ({len(its)})"]
        for fault in its:
            soak = " (shows in a soak only)" if fault.needs else ""
            lines.append(f"  {fault.name:{width}}  {fault.doc}{soak}")
    drawn = f"{PREFIX}SEED"
    wider = f"{PREFIX}SEED.NUMBER"
    lines += ["", "random", f"  {drawn:{width}}  one that is drawn: when x what, by the seed"]
    lines.append(f"  {wider:{width}}  one of wider families: needles, contexts, rhythms, wheels")
    return "\n".join(lines[1:])


def listed_variants(protocol: Protocol) -> str:
    """Return the text that lists every legal variant and then every mixture (which is a fault)."""
    known = faults.variants(protocol)
    mixed = faults.mixtures(protocol)
    width = max(len(name) for name in known)
    lines = [f"legal variants ({len(known)})"]
    for name, variant in known.items():
        option = f" (needs --allow {variant.row.allow})" if variant.row.allow else ""
        lines.append(f"  {name:{width}}  {variant.row.doc}{option}")
    lines += ["", f"mixtures of two choices, which do not conform ({len(mixed)})"]
    for name, fault in mixed.items():
        lines += [f"  {name}", f"      {fault.doc}"]
    return "\n".join(lines)
