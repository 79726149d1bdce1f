"""The bank of faulty devices, each of which misbehaves in one named way, and legal variants.

The faults are data, `faults.toml`: what a device does, when, and the cases that catch it. To add
one, add a table there. `hooks` makes the hooks of a simulated device from such data.

A text of a fault is a template with placeholders such as `{stop}`, `{setters[0].high}` or `{each}`,
which stand for the protocol's own names and numbers. One that names what a protocol does not have
is left out for that protocol.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from bilprov.conformance.dut.simulator import Event, Fault, React
from bilprov.conformance.mutation import effects
from bilprov.conformance.mutation.hooks import HOOKS
from bilprov.conformance.mutation.triggers import OUTCOMES, number_or_word, trigger
from bilprov.spec.by_effect import movers, moving_motions, setters, variable_of
from bilprov.spec.codec import bad_data, judge
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.readings import POINTS, Behaviour


class Name(str):
    """A name with attributes: numbers of an instruction, or an outcome in words."""


def _name(text: str, **attributes: object) -> Name:
    name = Name(text)
    vars(name).update(attributes)
    return name


def _instruction(protocol: Protocol, spec: InstructionSpec) -> Name:
    """Return an instruction's name, with what it sets and numbers of its first field.

    `one_bit_more` is the first value that has two bits more than those that are named, `bad_half`
    and `bad_upper` are values half way and two thirds through the bad ones.
    """
    attributes: dict[str, object] = {"id": spec.id, "motion": protocol.car.motion(spec.effect)}
    if spec.effect.assignments:
        attributes["variable"] = protocol.role_of[variable_of(spec)]
    for part in spec.fields[:1]:
        attributes |= {
            "header": protocol.header_bytes[spec.id, spec.length],
            "low": part.low,
            "middle": (part.low + part.high + 1) // 2,
            "high": part.high,
            "width": len(part.bits),
            "lowest_bit": part.bits[-1:],
            "one_bit_more": 2 << len(part.bits),
            "top": 8 * part.size - 1,
            "top_mask": 1 << 8 * part.size - 1,
        }
        bad = [spec.decode(data)[part.name] for data in bad_data(spec)]
        if bad:
            half, upper = bad[len(bad) // 2], bad[len(bad) * 2 // 3]
            attributes |= {"bad_half": half, "bad_upper": upper}
    return _name(spec.name, **attributes)


@cache
def names(protocol: Protocol) -> dict[str, Any]:
    """Return what placeholders stand for; the lists are what `each` of a row may go over."""

    def named(specs: Iterable[InstructionSpec]) -> list[Name]:
        return [_instruction(protocol, spec) for spec in specs]

    timing, motions = protocol.timing, list(moving_motions(protocol))
    roles = protocol.role_of
    tops = {roles[name]: high for name, (_, high) in protocol.limits.items()}
    settings = [
        (roles[variable_of(spec)], _instruction(protocol, spec)) for spec in setters(protocol)
    ]
    lit = named(s for s in protocol.instructions if any(part.bits for part in s.fields))
    found: dict[str, Any] = {
        "answer": {word: protocol.answers[outcome].name for word, outcome in OUTCOMES.items()},
        "code": {word: protocol.answers[outcome].code for word, outcome in OUTCOMES.items()},
        "unused_code": next(code for code in range(256) if code not in protocol.codes),
        "responses": protocol.responses,
        "outcomes": [
            _name(word, words=outcome.value)
            for word, outcome in OUTCOMES.items()
            if outcome is not Outcome.VALID
        ],
        "motions": motions,
        "still": protocol.car.still,
        "measured_motion": min(motions, default=""),
        "other_motions": [motion for motion in motions if motion != min(motions)],
        "movers": named(movers(protocol)),
        "moving": named(s for s in protocol.instructions if protocol.car.moves(s.effect)),
        "setters": [name for _, name in settings],
        "setting": dict(settings[::-1]),
        "steering": [name for variable, name in settings if variable == "steering"],
        "stop": _instruction(protocol, protocol.stop),
        "lit": lit,
        "bits": [name for name in lit if hasattr(name, "bad_half")],
        "unused": protocol.unused_ids,
        "longest": protocol.data_lengths[-1],
        "top": tops,
        "some": {name: tops.get(name, 0) // part for name, part in _SOME.items()},
        "timeout": int(timing.truncation_timeout),
        "late_answer": 1.2 * timing.answer_longest,
        "late_stop": 3 * timing.stop_longest,
    }
    ends = {"last_motion": motions, "last_unused": protocol.unused_ids}
    found |= {name: values[-1] for name, values in ends.items() if values}
    if "speed" in tops:
        found |= {"half_speed": tops["speed"] // 2, "high_speed": tops["speed"] * 3 // 4}
    if protocol.instructions[-1].effect.assignments:
        found["last"] = _instruction(protocol, protocol.instructions[-1])
    return found


_SOME = {"speed": 3, "led": 1, "steering": 12}
"""Variables and the part of the highest value that some device has at power-on."""


Rows = TypeVar("Rows")
AnyRow = TypeVar("AnyRow", bound="Row")


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fault as data, its texts templates over the protocol's `names`.

    Where `caught_by` or `clauses` is None it is that of the family.
    """

    doc: str
    what: str = ""
    when: str = ""
    since: str = ""
    until: str = ""
    each: str = ""
    caught_by: str | None = None
    clauses: str | None = None
    exit: int = 1
    needs: str = ""


class Family(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Faults that have much in common; `family` is its name where it is not that of its table."""

    clauses: str
    caught_by: str
    faults: dict[str, Row]
    family: str = ""


@cache
def fault_bank(protocol: Protocol) -> dict[str, Fault]:
    """Return every named fault of this protocol by name."""
    return {fault.name: fault for fault in all_faults(protocol)}


def all_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield every named fault of this protocol, family by family."""
    for key, family in table("faults.toml", dict[str, Family]).items():
        for name, row in filled(protocol, family.faults):
            yield Fault(
                name.lower().replace("_", "-"),
                family.family or key,
                row.doc,
                globs(family.caught_by if row.caught_by is None else row.caught_by),
                exit=row.exit,
                clauses=tuple((row.clauses or family.clauses).split()),
                needs=row.needs,
                **hooks(protocol, row),
            )


@cache
def table(name: str, kind: type[Rows]) -> Rows:
    """Return a file of this room as such values."""
    return msgspec.toml.decode(Path(__file__).with_name(name).read_bytes(), type=kind)


def filled(protocol: Protocol, templates: dict[str, AnyRow]) -> Iterator[tuple[str, AnyRow]]:
    """Yield the name and the row of each template, filled in; not those this protocol cannot fill.

    `each` of a row is a list of `names`: the row is filled in once for each of its values.
    """
    known = names(protocol)
    for name, row in templates.items():
        for value in known[row.each] if row.each else [""]:
            texts = {
                field: text
                for field in row.__struct_fields__
                if isinstance(text := getattr(row, field), str)
            }
            try:
                full = {f: text.format(**known, each=value) for f, text in texts.items()}
                yield name.format(**known, each=value), msgspec.structs.replace(row, **full)
            except (AttributeError, LookupError):
                continue


def globs(caught_by: str) -> tuple[str, ...]:
    """Return the globs of case ids that the words stand for."""
    known, found = table("caught_by.toml", dict[str, str]), dict[str, None]()
    for word in caught_by.split():
        found |= dict.fromkeys(globs(known[word]) if word in known else [word])
    return tuple(found)


def hooks(protocol: Protocol, row: Row) -> dict[str, Any]:
    """Return the hooks of a simulated device that does `what` at the trigger of the row."""
    acting = trigger(row.when, row.since, row.until)
    made: dict[str, Any] = {"trigger": acting, "what": row.what}
    gated: list[React] = []
    others: list[React] = []
    for part in row.what.split(";"):
        word, *arguments = part.split()
        given = [number_or_word(argument) for argument in arguments]
        if word in effects.EFFECTS:
            gated.append(effects.does_effect(word, *given))
        elif word in effects.WATCHING:
            others.append(effects.does_watching(word, acting, *given))
        else:
            found = HOOKS[word](protocol, acting, *given)
            others += [found.pop("react")] if "react" in found else []
            made |= found
    reacts = ([effects.at_frames(acting, effects.then(*gated))] if gated else []) + others
    if reacts:
        made["react"] = effects.then(*reacts) if len(reacts) > 1 else reacts[0]
    return made


# -- legal variants: devices that follow another reading than the reference -----------------------
# They are made from the open points (`spec.readings`) and from `variants.toml`. A variant never
# fails. A mixture does: a faulty device that follows one reading for some frames and another for
# the others. Only mixtures that can show both choices are made: one by ID, for example, needs two
# IDs at which the point arises.


FAMILY = "variant"
MIXTURE = "mixture:"


class VariantRow(Row, frozen=True, forbid_unknown_fields=True):
    """A variant as data; `chooses` are the words of choices by open point, `=` between them.

    `allow` names the option (`--allow`) without which the choice fails, "" if it is legal without
    one. `mixes` is true for a choice that a device must make the same way each time, as it must
    those of `chooses`: mixtures of it are faults.
    """

    chooses: str = ""
    allow: str = ""
    mixes: bool = False


@dataclass(frozen=True)
class Variant:
    """A legal variant: a choice other than the default at one reading.

    `name` is the reading's id, `=` and the choice.
    """

    protocol: Protocol
    name: str
    row: VariantRow

    @property
    def words(self) -> tuple[tuple[str, str], ...]:
        """The pairs of open point and choice from which it is made, if it is made from such."""
        pairs = (pair.split("=") for pair in self.row.chooses.split())
        return tuple((point.replace(":", " "), word) for point, word in pairs)

    @cached_property
    def fault(self) -> Fault:
        """The fault that makes a simulator take this choice each time."""
        return self.taking("", self.name, self.row.doc)

    def taking(self, when: str, name: str, doc: str) -> Fault:
        """Return the fault that takes this choice at frames of this trigger."""
        row = self.row
        if row.chooses:
            points = " ".join(pair.split("=")[0] for pair in row.chooses.split())
            what = ";".join(f"chooses {pair.replace('=', ' ')}" for pair in row.chooses.split())
            row = msgspec.structs.replace(row, when=f"open {points}", what=what)
        row = msgspec.structs.replace(row, when=f"{row.when}, {when}")
        return Fault(name, FAMILY, doc, exit=0, **hooks(self.protocol, row))


@cache
def variants(protocol: Protocol) -> dict[str, Variant]:
    """Return every legal variant by name: those of the table, then the choices left."""
    rows = table("variants.toml", dict[str, VariantRow])
    placed = [Variant(protocol, name, row) for name, row in filled(protocol, rows)]
    return {variant.name: variant for variant in (*placed, *_left(protocol, placed))}


def _left(protocol: Protocol, placed: Iterable[Variant]) -> Iterator[Variant]:
    """Yield a variant for each choice about an answer or the state that none of these makes."""
    made = {pair for variant in placed for pair in variant.words}
    for point in POINTS.values():
        for choice in point.choices[1:]:
            simple = choice.does not in (None, Behaviour.DISCARDED) and not choice.option
            if simple and (point.id, choice.word) not in made:
                reading, _, part = point.id.partition(" ")
                chooses = f"{point.id.replace(' ', ':')}={choice.word}"
                row = VariantRow(doc=f"{point.id}: {choice.word}", chooses=chooses)
                yield Variant(protocol, f"{reading}={part and part + '-'}{choice.word}", row)


_TIMES = 12  # how often the point arises before the device changes its choice


@cache
def mixtures(protocol: Protocol) -> dict[str, Fault]:
    """Return every mixture by name."""
    mixed = (v for v in variants(protocol).values() if v.row.mixes or v.row.chooses)
    return {fault.name: fault for variant in mixed for fault in _mixtures_of(protocol, variant)}


def _mixtures_of(protocol: Protocol, variant: Variant) -> Iterator[Fault]:
    """Yield the mixtures of one variant: by frame, by count, by ID and by motion, if both show."""
    ids, motions = _where_it_arises(protocol, variant)
    rows = [
        ("by-frame", "every second time", "times !& 1"),
        (
            f"after-{_TIMES}",
            f"after it has chosen otherwise {_TIMES} times",
            f"times >= {_TIMES}",
        ),
    ]
    if len(ids) > 1:
        some, others = (", ".join(map(str, part)) for part in (ids[::2], ids[1::2]))
        words = f"for ID {some} and not for {others}"
        rows.append(("by-id", words, f"id {some.replace(',', '')}"))
    if len(motions) > 1:
        moves = motions[1::2]
        words = f"while its motion is {' or '.join(moves)}"
        rows.append(("by-motion", words, f"motion {' '.join(moves)}"))
    for name, words, when in rows:
        fault = variant.taking(
            when, f"{MIXTURE}{variant.name}:{name}", f"{variant.row.doc}, but only {words}"
        )
        yield replace(
            fault,
            family="mixture",
            exit=1,
            caught_by=("reading/*",),
            clauses=("header", "instructions", "responses", "safety"),
        )


def _where_it_arises(protocol: Protocol, variant: Variant) -> tuple[list[int], list[str]]:
    """Return the IDs and the motions at which the device can take the choice."""
    acting = variant.fault.trigger
    assert acting is not None
    ids: set[int] = set()
    motions: dict[str, None] = {}
    for motion, event in _moments(protocol):
        if acting.holds(event, {}):
            ids.add(event.judgement.id)
            motions[motion] = None
    return sorted(ids), list(motions)


@cache
def _moments(protocol: Protocol) -> list[tuple[str, Event]]:
    """Each frame in each motion at the highest settings, as a device meets it."""
    top = {name: high for name, (_, high) in protocol.limits.items()}
    judgements = [judge(protocol, frame) for frame in _frames(protocol)]
    by, met = protocol.car.by, []
    for motion in protocol.variables[by].words:
        before = protocol.state(**{by: motion}, **top)
        for judgement in judgements:
            kind = "truncated" if judgement.truncated else "instruction"
            met.append((motion, Event(protocol, judgement, before, 0, 0, kind, 0)))
    return met


def _frames(protocol: Protocol) -> Iterator[bytes]:
    """Yield, for each header, low and high data, and the header alone."""
    for header, length in enumerate(protocol.lengths):
        for fill in (protocol.pad_byte, 0xFF):
            yield bytes([header]) + bytes([fill]) * length
        yield bytes([header])


# What tells of a fault; every other field is a hook or a setting, which a device has once. Only
# reactions can follow one another.
_TOLD = (
    "name",
    "family",
    "doc",
    "caught_by",
    "exit",
    "clauses",
    "needs",
    "what",
    "trigger",
)
_ONCE = tuple(f.name for f in fields(Fault) if f.name not in (*_TOLD, "react"))
_USUAL = Fault("", FAMILY, "", exit=0)


def hooks_of(fault: Fault) -> dict[str, Any]:
    """Return the hooks and settings besides the reaction that differ from the reference."""
    return {n: getattr(fault, n) for n in _ONCE if getattr(fault, n) != getattr(_USUAL, n)}
