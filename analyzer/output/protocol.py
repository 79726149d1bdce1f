"""Shows the protocol, how its frames are laid out, its readings and its errata: tables and JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from msgspec.structs import asdict
from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, parts_of, table
from bilprov.captures.text import quantity
from bilprov.spec.checks import CheckFunction, Fletcher, Sum, Xor
from bilprov.spec.codec import judge, spaced
from bilprov.spec.data import DataSpec
from bilprov.spec.explain import Finding
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import InstructionSpec, Protocol
from bilprov.spec.readings import ERRATA, EXAMPLES, Reading
from bilprov.spec.state import Changed, Effect, From, times, value_words


def _layouts(protocol: Protocol) -> Mapping[str, Layout]:
    """The layouts of a protocol by what they lay out: request, answer, errors."""
    named = {"request": protocol.layout, "answer": protocol.reply}
    if protocol.acknowledgement != protocol.reply:
        named["answer without data"] = protocol.acknowledgement
    return named | {
        "error" if len(protocol.errors) == 1 else f"error {number}": layout
        for number, layout in enumerate(protocol.errors, 1)
    }


def _parts(layout: Layout) -> Iterator[tuple[str, str, str, Part | None]]:
    """The parts of a layout, each with its size and meaning in words; the data are no Part."""
    parts: list[Part | None] = [*layout.parts]
    if layout.has_data:
        parts.insert(sum(part.offset >= 0 for part in layout.parts), None)
    for part in parts:
        if part is None:
            yield "data", "..", "the fields of the instruction", None
            continue
        size = quantity(part.width, "bit") if part.width else str(part.size)
        if part.size > 1 and part.role != "constant" and part.number.order == "little":
            size += ", low first"
        yield part.name, size, "; ".join(filter(None, (part.prose, _meaning(layout, part)))), part


def _meaning(layout: Layout, part: Part) -> str:
    """What a part holds, in words."""
    if part.role == "constant":
        return part.constant.hex(" ") or f"always {part.low}"
    if part.same:
        return f"as in the request{f', plus {part.plus}' if part.plus else ''}"
    if part.role == "address":
        broadcast = "" if part.broadcast is None else f", {part.broadcast} is all"
        return f"{part.low} to {part.high}{broadcast}"
    if part.role == "length":
        return f"the data bytes{f' and {part.also} more' if part.also else ''}"
    if part.role == "code":
        return "one of the responses"
    if part.role != "check" or not layout.check:
        return ""
    before = "the request's covered bytes and " if layout.check.asked else ""
    names = [p.name for p in layout.parts if layout.check.first <= p.offset < layout.head]
    names += ["data"] if layout.has_data else []
    covered = " to ".join(dict.fromkeys([names[0], names[-1]]))
    words = f"{_check(layout.check.function)} of {before}{covered}"
    without = ", ".join(map(str, sorted(layout.unchecked)))
    return f"{words}; none for ID {without}" if without else words


def _check(function: CheckFunction) -> str:
    """A check in words, like `CRC-16, polynomial 8005, start ffff, reflected`."""
    if isinstance(function, Sum):
        return f"{function.bits}-bit sum{('', ', inverted,', ', negative,')[function.complement]}"
    if isinstance(function, Fletcher):
        return f"Fletcher's two sums, modulo {function.modulus}"
    if isinstance(function, Xor):
        return f"exclusive or from {function.start:02x}"
    digits = -(-function.width // 4)
    said = f"CRC-{function.width} (polynomial {function.poly:0{digits}x}"
    said += f", start {function.init:0{digits}x}" + (", reflected" if function.reflected else "")
    if function.refout is not function.reflected:
        said += ", result reflected" if function.refout else ", result not reflected"
    return said + (f", combined with {function.xorout:0{digits}x})" if function.xorout else ")")


def _data(data: DataSpec) -> str:
    """The fields of data with what they allow; a constant stands as its bytes."""
    words = []
    for part in data.fields:
        flags = f" ({' '.join(name for name, _ in part.flags)})" if part.flags else ""
        allowed = f"{part.name}={part.allowed_in_short}{flags}"
        words.append(allowed if part.constant is None else part.constant.hex(" "))
    return " ".join(words)


def drawn_protocol(protocol: Protocol) -> Iterator[RenderableType]:
    """Yield the tables of header, instructions, responses, effects and defaults."""
    yield heading(f"{protocol.name} {protocol.version}")
    yield Text(protocol.document, style="dim")
    yield Text(f"grammar {protocol.origin}, sha256 {protocol.sha256}", style="dim")
    if protocol.plain:
        yield from _titled(f"Header, one byte ({protocol.clauses.header})")
        bits = [(str(part.width), part.name, part.prose) for part in protocol.layout.parts]
        yield table(("bits", "name", "meaning"), bits, right="bits")
    for name, layout in {} if protocol.plain else _layouts(protocol).items():
        yield from _titled(f"{name.capitalize()} ({protocol.clauses.header})")
        yield table(("part", "bytes", "meaning"), [row[:3] for row in _parts(layout)])
    yield from _titled(f"Instructions ({protocol.clauses.instructions})")
    yield _instructions(protocol)
    if protocol.plain and protocol.unused_ids:
        answer = protocol.answers[Outcome.UNKNOWN_ID].name
        unused = ", ".join(map(str, protocol.unused_ids))
        stops = f", stops the {protocol.device}" if protocol.stops(protocol.on_fault) else ""
        yield Text(f"  unused: {unused} (answered {answer}{stops})", style="dim")
    for memory, cells in protocol.registers.items():
        yield from _titled(f"Named {memory}")
        rows = [(str(at), one.name, one.allowed_in_short, one.prose) for at, one in cells.items()]
        yield table(("place", "name", "allowed", "meaning"), rows, right="place")
    if protocol.plain or any(spec.effect.assignments for spec in protocol.instructions):
        yield from _titled(f"Effects on the {'motion state' if protocol.at_rest else 'state'}")
        yield table(("after", "becomes"), _effect_rows(protocol))
    if protocol.responses:
        size = ", one byte" if protocol.plain else ""
        yield from _titled(f"Responses{size} ({protocol.clauses.responses})")
        rows = [(str(r.code), r.name, r.document, r.prose) for r in protocol.responses]
        yield table(("code", "name", "document", "meaning"), rows, right="code")
    yield from _titled("Defaults where the document is silent")
    yield facts(_defaults(protocol))


def _titled(text: str) -> Iterator[RenderableType]:
    yield Text()
    yield heading(text)


def _instructions(protocol: Protocol) -> RenderableType:
    """The instructions with their data: in the car's family with the frame, else the answer."""
    rows: list[tuple[str, ...]] = []
    for spec in protocol.instructions:
        told, data = (spec.name, spec.document), _data(spec)
        if protocol.plain:
            header = f"{protocol.header_bytes[spec.id, spec.length]:02x}"
            rows.append((str(spec.id), *told, header + " .." * spec.length, data, spec.prose))
        else:
            answer = "none" if spec.answer is None else _data(spec.answer)
            rows.append((str(spec.id), *told, data, answer, spec.prose))
    more = ("frame", "data") if protocol.plain else ("data", "answer")
    columns: tuple[str, ...] = ("id", "name", "document", *more, "meaning")
    if not any(spec.prose for spec in protocol.instructions):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return table(columns, rows, right="id")


def _effect_rows(protocol: Protocol) -> Iterator[tuple[str, str]]:
    effects = {spec.name: spec.effect for spec in protocol.instructions}
    for name, effect in (effects | {"a faulty instruction": protocol.on_fault}).items():
        words = [
            f"{variable} = {times(value.factor)}{value.field}"
            if isinstance(value, From)
            else f"{variable} = {value_words(value)}"
            for variable, value in effect.assignments
        ]
        yield name, ", ".join(words) or "nothing changes"
    start = parts_of(protocol.power_on, *protocol.variables)
    yield "power-on", ", ".join(f"{name} = {value}" for name, value in start.items())


def _defaults(protocol: Protocol) -> Iterator[tuple[str, str]]:
    line, timing = protocol.line, protocol.timing
    yield "line", f"{line.baud} baud, 8 data bits, parity {line.parity}, {line.stopbits:g} stop"
    for name, value in asdict(timing).items():
        yield name.replace("_", " "), f"{value:g} ms"


def protocol_json(protocol: Protocol) -> dict[str, Any]:
    """The whole protocol for machines."""
    return {
        **parts_of(protocol, "name", "version", "document"),
        "grammar": parts_of(protocol, "origin", "sha256"),
        **_frames_json(protocol),
        "instructions": [_instruction_json(protocol, spec) for spec in protocol.instructions],
        "unused_ids": list(protocol.unused_ids),
        "responses": [
            {
                **parts_of(response, "code", "name", "document", "prose"),
                "outcome": ", ".join(outcome.value for outcome in response.outcomes),
            }
            for response in protocol.responses
        ],
        "on_fault": _effect_json(protocol.on_fault),
        "power_on": parts_of(protocol.power_on, *protocol.variables),
        "timing_ms": asdict(protocol.timing),
        "line": asdict(protocol.line),
        "clauses": asdict(protocol.clauses),
    }


def _frames_json(protocol: Protocol) -> dict[str, Any]:
    """How frames are laid out: the parts of the header byte, or of each layout."""
    if protocol.plain:
        parts = protocol.layout.parts
        bits = [{"name": one.name, "bits": one.width, "meaning": one.prose} for one in parts]
        return {"header": bits}
    layouts = {
        name: [
            {"part": part.name, "kind": part.role, "bytes": part.size, "bits": part.width}
            | {"meaning": meaning}
            if part
            else {"part": name}
            for name, _, meaning, part in _parts(layout)
        ]
        for name, layout in _layouts(protocol).items()
    }
    registers = {
        memory: [
            {"place": at, **parts_of(one, "name", "prose"), "allowed": one.allowed_in_short}
            for at, one in cells.items()
        ]
        for memory, cells in protocol.registers.items()
    }
    return {"layouts": layouts, **({"registers": registers} if registers else {})}


def _instruction_json(protocol: Protocol, spec: InstructionSpec) -> dict[str, Any]:
    about = parts_of(spec, "id", "name", "document", "prose")
    if protocol.plain:
        shown = ("name", "prose", "offset", "size", "low", "high", "bits")
        about |= {
            "length": spec.length,
            "header": f"{protocol.header_bytes[spec.id, spec.length]:02x}",
            "fields": [parts_of(field, *shown) for field in spec.fields],
        }
    else:
        about["fields"] = _fields_json(spec)
        about["answer"] = None if spec.answer is None else _fields_json(spec.answer)
    return {**about, "effect": _effect_json(spec.effect)}


def _fields_json(data: DataSpec) -> list[dict[str, Any]]:
    return [
        {
            **parts_of(part, "name", "prose", "offset"),
            "size": None if part is data.fields[-1] and data.counted else part.size,
            "allowed": part.constant.hex() if part.constant else part.allowed_in_short,
        }
        for part in data.fields
    ]


def _effect_json(effect: Effect) -> dict[str, Any]:
    def told(value: Any) -> Any:
        if isinstance(value, From):
            return parts_of(value, "field", "factor")
        return asdict(value) if isinstance(value, Changed) else value

    return {variable: told(value) for variable, value in effect.assignments}


def drawn_readings(readings: Sequence[Reading]) -> Iterator[RenderableType]:
    """Yield each reading in full: the point, the document's words, our default, other choices."""
    for index, reading in enumerate(readings):
        if index:
            yield Text()
        yield heading(reading.id, reading.point)
        yield facts(
            [
                ("clause", reading.clause),
                ("document", f'"{reading.quote}"' if reading.quote else "silent"),
                ("default", Text(reading.default, style="green")),
                *((verdict, choice) for choice, verdict in reading.others),
            ]
        )


def reading_json(reading: Reading, *keys: str) -> dict[str, Any]:
    """These parts of a reading, and its other choices with their verdicts."""
    others = [{"choice": choice, "verdict": verdict} for choice, verdict in reading.others]
    return parts_of(reading, *keys) | {"others": others}


def drawn_errata(protocol: Protocol, findings: Sequence[Finding]) -> Iterator[RenderableType]:
    """Yield the errata that the document's own examples show, then those found otherwise."""
    yield heading(
        f"{len(EXAMPLES)} example lines of the document run through the grammar: "
        f"{len(findings)} contradict{'s' if len(findings) == 1 else ''} its own tables"
    )
    for finding in findings:
        example, erratum, meant = finding.example, finding.erratum, finding.meant
        yield Text()
        words = f"example {example.section}, line {example.line}: {example.bits}"
        yield heading(erratum.id if erratum else "new", words)
        yield facts(
            [
                ("document", f'"{example.comment}"'),
                ("found", finding.reason),
                ("nearest", f"{spaced(meant)}  {judge(protocol, meant).describe()}"),
                ("correction", erratum.correction if erratum else ""),
            ]
        )
    found = [finding.erratum for finding in findings]
    yield from _titled("Not found by running the examples")
    for erratum in ERRATA:
        if erratum not in found:
            yield heading(erratum.id, f"{erratum.clause}; it takes {erratum.shows} to see it")
            yield facts([("document", f'"{erratum.quote}"'), ("correction", erratum.correction)])


def errata_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """The errata as a JSON object: `found` by running the examples, and `all` known ones."""
    return {
        "examples": len(EXAMPLES),
        "found": [
            {
                "id": finding.erratum.id if finding.erratum else None,
                "example": finding.example._asdict(),
                "sent": spaced(finding.sent),
                "reason": finding.reason,
                "nearest": spaced(finding.meant),
            }
            for finding in findings
        ],
        "all": [erratum._asdict() for erratum in ERRATA],
    }
