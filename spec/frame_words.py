"""Words for the parts of FRAME, REPLY and ERROR, each a construct that parses by construct alone.

A reply is parsed with the request that it answers: `REPLY.parse(raw, asked=question(FRAME, sent))`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from construct import Adapter, Construct, Container, Subconstruct, ValidationError, this

from bilprov.spec.value_checks import WrongValue, require_kind, require_name, require_whole

asked = this._params.asked
"""The request that a reply answers: `Bytes(asked.size)` has as many bytes as its field `size`."""


class Address(Subconstruct):  # type: ignore[misc]  # construct ships no types
    """The part that names who is meant: `low` to `high`, and `broadcast` for all, if there is one.

    What is sent to all is not answered.
    """

    def __init__(
        self, subcon: Construct, low: int, high: int, broadcast: int | None = None
    ) -> None:
        require_kind("the type of an Address", subcon, Construct)
        require_whole("the lowest address", low, 0)
        require_whole("the highest address", high, 0)
        if low > high:
            raise WrongValue(f"the addresses {low} to {high} hold nothing")
        if broadcast is not None:
            require_whole("the broadcast address", broadcast, 0)
        super().__init__(subcon)
        self.low = low
        self.high = high
        self.broadcast = broadcast


class Length(Adapter):  # type: ignore[misc]  # construct ships no types
    """The part that announces the data; it counts `also` bytes more than the data have."""

    def __init__(self, subcon: Construct, also: int = 0) -> None:
        require_kind("the type of a Length", subcon, Construct)
        require_whole("what a Length counts besides the data", also, -255, 255)
        super().__init__(subcon)
        self.also = also

    def _decode(self, obj: Any, context: Any, path: str) -> int:
        return int(obj - self.also)

    def _encode(self, obj: Any, context: Any, path: str) -> int:
        return int(obj + self.also)


class Same(Subconstruct):  # type: ignore[misc]  # construct ships no types
    """The part of a reply that repeats the request's part `name`, with `plus` added to it.

    What does not fit into the type is cut off.
    """

    def __init__(self, name: str, subcon: Construct, plus: int = 0) -> None:
        require_name("the part that a Same repeats", name)
        require_kind("the type of a Same", subcon, Construct)
        require_whole("what a Same adds", plus, 0)
        super().__init__(subcon)
        self.part = name
        self.plus = plus

    def _parse(self, stream: Any, context: Any, path: str) -> int:
        value = int(self.subcon._parsereport(stream, context, path))
        expected = self._repeated(context)
        if value != expected:
            raise ValidationError(f"{self.part} is {value}, the request has {expected}", path)
        return value

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> int:
        value = self._repeated(context)
        self.subcon._build(value, stream, context, path)
        return value

    def _repeated(self, context: Any) -> int:
        value = context._params.asked[self.part] + self.plus
        return int(value % (1 << 8 * self.subcon.sizeof()))


class Data(Construct):  # type: ignore[misc]  # construct ships no types
    """The data of a reply, as `answer=` of the instruction lays them out that was asked."""

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        answer = context._params.asked._answer
        return answer._parsereport(stream, context, path) if answer is not None else None

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        answer = context._params.asked._answer
        return answer._build(obj, stream, context, path) if answer is not None else None


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
