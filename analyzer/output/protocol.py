"""Shows the protocol, how its frames are laid out, its readings and its errata: tables and JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from msgspec.structs import asdict
from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, table
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.text import quantity
from bilprov.spec.checks import CheckFunction, Fletcher, Sum, Xor
from bilprov.spec.codec import judge, spaced
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.explain import Finding
from bilprov.spec.fields import Outcome
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import InstructionSpec, Protocol, ResponseSpec
from bilprov.spec.readings import ERRATA, EXAMPLES, READINGS, Reading
from bilprov.spec.state import Changed, Effect, From, times, value_words


def layouts_of(protocol: Protocol) -> Mapping[str, Layout]:
    """The layouts of a protocol by what they lay out: request, answer, errors."""
    named = {"request": protocol.layout, "answer": protocol.reply}
    if protocol.acknowledgement != protocol.reply:
        named["answer without data"] = protocol.acknowledgement
    return named | {
        "error" if len(protocol.errors) == 1 else f"error {number}": layout
        for number, layout in enumerate(protocol.errors, 1)
    }


def drawn_layouts(protocol: Protocol) -> Iterator[RenderableType]:
    """Yield a table of the parts of each layout."""
    for name, layout in layouts_of(protocol).items():
        yield Text()
        yield heading(f"{name.capitalize()} ({protocol.clauses.header})")
        yield table(("part", "bytes", "meaning"), list(_rows(layout)))


def _rows(layout: Layout) -> Iterator[tuple[str, str, str]]:
    for part in _in_order(layout):
        yield _row(layout, part) if part else ("data", "..", "the fields of the instruction")


def _in_order(layout: Layout) -> list[Part | None]:
    """The parts of a layout, and None for the place of its data."""
    parts: list[Part | None] = [*layout.parts]
    if layout.has_data:
        parts.insert(sum(part.offset >= 0 for part in layout.parts), None)
    return parts


def _row(layout: Layout, part: Part) -> tuple[str, str, str]:
    size = quantity(part.width, "bit") if part.width else str(part.size)
    if part.size > 1 and part.role != "constant" and part.number.order == "little":
        size += ", low first"
    return part.name, size, "; ".join(filter(None, (part.prose, _meaning(layout, part))))


def _meaning(layout: Layout, part: Part) -> str:
    """What a part holds, in words."""
    if part.role == "constant":
        return part.constant.hex(" ") or f"always {part.low}"
    if part.same:
        return f"as in the request{f', plus {part.plus}' if part.plus else ''}"
    if part.role == "address":
        return f"{part.low} to {part.high}" + (
            f", {part.broadcast} is all" if part.broadcast is not None else ""
        )
    if part.role == "length":
        return "the data bytes" + (f" and {part.also} more" if part.also else "")
    if part.role == "code":
        return "one of the responses"
    if part.role == "check" and layout.check:
        before = "the request's covered bytes and " if layout.check.asked else ""
        return f"{check_in_words(layout.check.function)} of {before}{_covered(layout)}"
    return ""


def _covered(layout: Layout) -> str:
    """The parts that the check counts, in words."""
    assert layout.check is not None
    last = "data" if layout.has_data else ""
    names = [p.name for p in layout.parts if layout.check.first <= p.offset < layout.head]
    first, last = names[0] if names else last, last or names[-1]
    return first if first == last else f"{first} to {last}"


def check_in_words(function: CheckFunction) -> str:
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


def layout_json(layout: Layout) -> list[dict[str, Any]]:
    """The parts of a layout in order for machines; the data are a part without a size."""
    rows: list[dict[str, Any]] = []
    for part in _in_order(layout):
        if part is None:
            rows.append({"part": "data"})
            continue
        kind = {"part": part.name, "kind": part.role, "bytes": part.size, "bits": part.width}
        rows.append({**kind, "meaning": _row(layout, part)[2]})
    return rows


def data_in_words(data: DataSpec) -> str:
    """The fields of data with what they allow; a constant stands as its bytes."""
    return " ".join(map(_field_in_words, data.fields))


def _field_in_words(part: FieldSpec) -> str:
    if part.constant is not None:
        return part.constant.hex(" ")
    flags = f" ({' '.join(name for name, _ in part.flags)})" if part.flags else ""
    return f"{part.name}={part.allowed_in_short}{flags}"


def drawn_protocol(protocol: Protocol) -> Iterator[RenderableType]:
    """Yield the tables of header, instructions, responses, effects and defaults."""
    yield heading(f"{protocol.name} {protocol.version}")
    yield Text(protocol.document, style="dim")
    yield Text(f"grammar {protocol.origin}, sha256 {protocol.sha256}", style="dim")
    yield from _header(protocol) if protocol.plain else drawn_layouts(protocol)
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


def _header(protocol: Protocol) -> Iterator[RenderableType]:
    yield from _titled(f"Header, one byte ({protocol.clauses.header})")
    rows = [(str(part.width), part.name, part.prose) for part in protocol.layout.parts]
    yield table(("bits", "name", "meaning"), rows, right="bits")


def _titled(text: str) -> Iterator[RenderableType]:
    yield Text()
    yield heading(text)


def _instructions(protocol: Protocol) -> RenderableType:
    """The instructions with their data: in the car's family with the frame, else the answer."""
    rows: list[tuple[str, ...]] = []
    for spec in protocol.instructions:
        told, data = (spec.name, spec.document), data_in_words(spec)
        if protocol.plain:
            header = f"{protocol.header_bytes[spec.id, spec.length]:02x}"
            rows.append((str(spec.id), *told, header + " .." * spec.length, data, spec.prose))
        else:
            answer = "none" if spec.answer is None else data_in_words(spec.answer)
            rows.append((str(spec.id), *told, data, answer, spec.prose))
    more = ("frame", "data") if protocol.plain else ("data", "answer")
    columns: tuple[str, ...] = ("id", "name", "document", *more, "meaning")
    if not any(spec.prose for spec in protocol.instructions):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    return table(columns, rows, right="id")


def _effect_rows(protocol: Protocol) -> Iterator[tuple[str, str]]:
    for spec in protocol.instructions:
        yield spec.name, _effect(spec.effect)
    yield "a faulty instruction", _effect(protocol.on_fault)
    start = _power_on(protocol)
    yield "power-on", ", ".join(f"{name} = {value}" for name, value in start.items())


def _power_on(protocol: Protocol) -> dict[str, Any]:
    """The value of each variable at power-on."""
    return {name: getattr(protocol.power_on, name) for name in protocol.variables}


def _effect(effect: Effect) -> str:
    words = [
        f"{variable} = {times(value.factor)}{value.field}"
        if isinstance(value, From)
        else f"{variable} = {value_words(value)}"
        for variable, value in effect.assignments
    ]
    return ", ".join(words) or "nothing changes"


def _defaults(protocol: Protocol) -> Iterator[tuple[str, str]]:
    line, timing = protocol.line, protocol.timing
    yield "line", f"{line.baud} baud, 8 data bits, parity {line.parity}, {line.stopbits:g} stop"
    for name, value in asdict(timing).items():
        yield name.replace("_", " "), f"{value:g} ms"


def drawn_grammars(protocols: Sequence[Protocol]) -> Iterator[RenderableType]:
    """Yield the table of the kit's grammars."""
    rows = [(p.name, p.version, str(line_settings(p)), p.document) for p in protocols]
    yield table(("name", "version", "line", "document"), rows)


def grammars_json(protocols: Sequence[Protocol]) -> list[dict[str, Any]]:
    """The kit's grammars for machines."""
    return [
        {
            "name": protocol.name,
            "version": protocol.version,
            "document": protocol.document,
            "line": asdict(protocol.line),
            "sha256": protocol.sha256,
        }
        for protocol in protocols
    ]


def protocol_json(protocol: Protocol) -> dict[str, Any]:
    """The whole protocol for machines."""
    return {
        "name": protocol.name,
        "version": protocol.version,
        "document": protocol.document,
        "grammar": {"origin": protocol.origin, "sha256": protocol.sha256},
        **_frames_json(protocol),
        "instructions": [_instruction_json(protocol, spec) for spec in protocol.instructions],
        "unused_ids": list(protocol.unused_ids),
        "responses": [_response_json(response) for response in protocol.responses],
        "on_fault": _effect_json(protocol.on_fault),
        "power_on": _power_on(protocol),
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
    layouts = {name: layout_json(layout) for name, layout in layouts_of(protocol).items()}
    registers = {
        memory: [
            {"place": at, "name": one.name, "prose": one.prose, "allowed": one.allowed_in_short}
            for at, one in cells.items()
        ]
        for memory, cells in protocol.registers.items()
    }
    return {"layouts": layouts, **({"registers": registers} if registers else {})}


def _instruction_json(protocol: Protocol, spec: InstructionSpec) -> dict[str, Any]:
    about = {name: getattr(spec, name) for name in ("id", "name", "document", "prose")}
    if protocol.plain:
        shown = ("name", "prose", "offset", "size", "low", "high", "bits")
        about |= {
            "length": spec.length,
            "header": f"{protocol.header_bytes[spec.id, spec.length]:02x}",
            "fields": [{name: getattr(field, name) for name in shown} for field in spec.fields],
        }
    else:
        about["fields"] = _fields_json(spec)
        about["answer"] = None if spec.answer is None else _fields_json(spec.answer)
    return {**about, "effect": _effect_json(spec.effect)}


def _fields_json(data: DataSpec) -> list[dict[str, Any]]:
    return [
        {
            "name": part.name,
            "prose": part.prose,
            "offset": part.offset,
            "size": None if part is data.fields[-1] and data.counted else part.size,
            "allowed": part.constant.hex() if part.constant else part.allowed_in_short,
        }
        for part in data.fields
    ]


def _effect_json(effect: Effect) -> dict[str, Any]:
    def told(value: Any) -> Any:
        if isinstance(value, From):
            return {"field": value.field, "factor": value.factor}
        return asdict(value) if isinstance(value, Changed) else value

    return {variable: told(value) for variable, value in effect.assignments}


def drawn_readings(readings: Sequence[Reading] = READINGS) -> Iterator[RenderableType]:
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


def readings_json(readings: Sequence[Reading]) -> list[dict[str, Any]]:
    """The readings as JSON objects; `others` are pairs of choice and verdict."""
    return [
        reading_json(reading, "id", "clause", "point", "quote", "default") for reading in readings
    ]


def reading_json(reading: Reading, *keys: str) -> dict[str, Any]:
    """These parts of a reading, and its other choices with their verdicts."""
    others = [{"choice": choice, "verdict": verdict} for choice, verdict in reading.others]
    return {key: getattr(reading, key) for key in keys} | {"others": others}


def drawn_errata(protocol: Protocol, findings: Sequence[Finding]) -> Iterator[RenderableType]:
    """Yield the errata that the document's own examples show, then those found otherwise."""
    yield heading(
        f"{len(EXAMPLES)} example lines of the document run through the grammar: "
        f"{len(findings)} contradict{'s' if len(findings) == 1 else ''} its own tables"
    )
    for finding in findings:
        name = finding.erratum.id if finding.erratum else "new"
        meant = judge(protocol, finding.meant)
        yield Text()
        title = Text(name, style="bold red")
        title.append(
            f"  example {finding.example.section}, line {finding.example.line}: "
            f"{finding.example.bits}",
            style="not bold default",
        )
        yield title
        yield facts(
            [
                ("document", f'"{finding.example.comment}"'),
                ("found", finding.reason),
                ("nearest", f"{spaced(finding.meant)}  {meant.describe()}"),
                ("correction", finding.erratum.correction if finding.erratum else ""),
            ]
        )
    found = [finding.erratum for finding in findings]
    rest = [erratum for erratum in ERRATA if erratum not in found]
    yield from _titled("Not found by running the examples")
    for erratum in rest:
        yield heading(erratum.id, f"{erratum.clause}; it takes {erratum.shows} to see it")
        yield facts([("document", f'"{erratum.quote}"'), ("correction", erratum.correction)])


def errata_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """The errata as a JSON object: `found` by running the examples, and `all` known ones."""
    return {
        "examples": len(EXAMPLES),
        "found": [
            {
                "id": finding.erratum.id if finding.erratum else None,
                "example": dataclasses.asdict(finding.example),
                "sent": spaced(finding.sent),
                "reason": finding.reason,
                "nearest": spaced(finding.meant),
            }
            for finding in findings
        ],
        "all": [dataclasses.asdict(erratum) for erratum in ERRATA],
    }


def _response_json(response: ResponseSpec) -> dict[str, Any]:
    values = asdict(response)
    del values["outcomes"]
    return {**values, "outcome": ", ".join(outcome.value for outcome in response.outcomes)}
