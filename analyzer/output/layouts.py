"""Shows how frames are laid out, as tables and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from bilprov.analyzer.output.console import heading, table
from bilprov.spec.checks import CheckFunction, Sum, Xor
from bilprov.spec.data import DataSpec, FieldSpec
from bilprov.spec.layout import Layout, Part
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from rich.console import RenderableType


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
    from rich.text import Text

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
    size = f"{part.width} bits" if part.width else str(part.size)
    if part.size > 1 and part.role != "constant" and part.number.order == "little":
        size += ", low first"
    return part.name, size, "; ".join(filter(None, (part.prose, _meaning(layout, part))))


def _meaning(layout: Layout, part: Part) -> str:
    """What a part holds, in words."""
    if part.role == "constant":
        return part.constant.hex(" ")
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
    if isinstance(function, Xor):
        return f"exclusive or from {function.start:02x}"
    digits = function.width // 4
    said = f"CRC-{function.width} (polynomial {function.poly:0{digits}x}"
    said += f", start {function.init:0{digits}x}" + (", reflected" if function.reflected else "")
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
