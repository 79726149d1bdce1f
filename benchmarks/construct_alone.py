"""Parses the answers of a grammar by construct alone, as a judge that does not depend on the kit.

`REPLY.parse(raw, asked=question(FRAME, sent))`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from construct import Construct, Container


def question(frame: Construct, raw: bytes) -> Container:
    """The request that a reply needs as `asked`: the parts and data fields of the frame `raw`.

    Raises construct's errors for bytes that are no frame.
    """
    found = Container(_answer=None)
    for name, value in _flat(frame.parse(raw)):
        found.setdefault(name, value)
    found._answer = getattr(_instruction_of(frame, found.get("id")), "answer", None)
    return found


def _flat(parsed: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The values within a parsed frame by name, of whatever stands inside each other."""
    for name, value in parsed.items():
        if name.startswith("_"):
            continue
        if isinstance(value, Mapping):
            inner = value["value"] if "value" in value and "offset1" in value else value
            if inner is not value:
                yield name, Container(data=value["data"])
            if isinstance(inner, Mapping):
                yield from _flat(inner)
        else:
            yield name, value


def _instruction_of(declared: Any, identity: Any) -> Any:
    """The instruction with that ID within a frame's declaration; None for an unused one."""
    cases = getattr(declared, "cases", None)
    if isinstance(cases, dict):
        found = cases.get(identity)
        while found is not None and hasattr(found, "subcon"):
            found = found.subcon
        return found
    inside = [*getattr(declared, "subcons", ()), getattr(declared, "subcon", None)]
    for one in inside:
        if one is not None and (found := _instruction_of(one, identity)) is not None:
            return found
    return None
