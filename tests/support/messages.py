"""The messages of a capture with their values, as tests look at them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cache
from typing import Any

import msgspec

from bilprov.captures import topics
from bilprov.captures.reader import Capture
from bilprov.captures.storage.records import JSON_ERRORS


class Message(msgspec.Struct, frozen=True):
    """One message of any topic: `t` is ns since the capture's start.

    `value` is the decoded JSON object, with None for what a bilprov message left out, or the bytes
    if the message is not a JSON object.
    """

    topic: str
    t: int
    value: dict[str, Any] | bytes
    sequence: int


def messages(capture: Capture, wanted: Collection[str] | None = None) -> Iterator[Message]:
    """The messages of all topics that the file describes, or of those `wanted`, in order."""
    rows = {row.name: topics.CAR_SHAPES.get(row.value, row.value) for row in topics.TOPICS}
    encodings = dict(capture.contents.channels.values())
    for message in capture.messages(wanted):
        value: Any = message.data
        if encodings[message.topic] == topics.JSON_ENCODING:
            try:
                value = msgspec.json.decode(message.data)
            except JSON_ERRORS:
                value = message.data
        if isinstance(value, dict) and message.topic in rows:
            value = {**dict.fromkeys(_optional(rows[message.topic])), **value}
            beside = topics.BESIDE.items()  # an older kit wrote each time once
            value = {**{two: value[one] for one, two in beside if one in value}, **value}
        whole = isinstance(value, dict | bytes)
        yield Message(message.topic, message.t, value if whole else message.data, message.sequence)


@cache
def _optional(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    """The fields that a message leaves out when they are None."""
    fields = msgspec.structs.fields(kind)
    return tuple(one.name for one in fields if type(None) in getattr(one.type, "__args__", ()))
