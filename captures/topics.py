"""The topics of a capture: their names, encodings, channel ids and the values they carry.

The channel ids are fixed, so that a file whose channel table is lost can still be read. The JSON
Schemas are made from the values and flattened to what Foxglove's parser accepts: the top level is
an object, there are no references, every property has one plain type, every object lists its
properties. A property that may be None is therefore optional, and left out of the message when it
is None.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeAlias

import msgspec

from bilprov.captures import schemas
from bilprov.spec import grammar
from bilprov.spec.state import State, state_class

Written: TypeAlias = schemas.Timed | State | schemas.Log
"""A value that becomes a message on the topic of its type."""

HOST_RAW = "/host/raw"
DEVICE_RAW = "/device/raw"
LINE = "/line"
CASES = "/conformance/cases"
LOOKS = "/conformance/looks"
ASKS = "/conformance/asks"
CHECKPOINT = "/checkpoint"

METADATA_NAME = "bilprov"
START_KEY = "start"  # in the metadata: the wall clock at t = 0, ns
MACHINE = "machine"  # in the metadata: the name of the machine that recorded
GRAMMAR_HASH = "grammar_sha256"  # of the grammar by which it was recorded
GRAMMAR_TEXT = "grammar_text"  # that grammar itself, as far as it fits
HISTORY = "history"  # what was done to the recording, edit by edit
PART = "part"  # the number of this part, from 1, of a recording that is kept in several
CUT_START = "cut_start_ns"  # where a part, also one that was cut out, begins, ns since `start`
CUT_END = "cut_end_ns"
CHANNEL_START_KEY = "bilprov.start"  # the same in each channel's metadata

RAW_ENCODING = "application/octet-stream"
JSON_ENCODING = "json"

SINCE_START = (
    "Integer nanoseconds since the capture's start; `log_time` is wall clock at start + this."
)
TIMES = {
    "t": SINCE_START,
    "end": SINCE_START,
    "begun": SINCE_START,
    "latency": "Integer nanoseconds from the instruction's last byte to this byte.",
    "t_ns": "The same as `t`: integer nanoseconds since the capture's start.",
    "latency_ns": "The same as `latency`, in integer nanoseconds.",
}
BESIDE = {"t": "t_ns", "latency": "latency_ns"}
"""Fields that a message has twice, the second time under a name that tells the unit."""


class Topic(msgspec.Struct, frozen=True):
    """One row of the topic table: a topic and the messages that it carries.

    `channel` is the fixed channel id, from 1; `schema` is the schema's name, empty for raw bytes.
    """

    name: str
    channel: int
    encoding: str
    schema: str
    value: type[msgspec.Struct]


TOPICS: tuple[Topic, ...] = (
    Topic(HOST_RAW, 1, RAW_ENCODING, "", schemas.Chunk),
    Topic(DEVICE_RAW, 2, RAW_ENCODING, "", schemas.Chunk),
    Topic("/host/instructions", 3, JSON_ENCODING, "bilprov.Instruction", schemas.Instruction),
    Topic("/device/responses", 4, JSON_ENCODING, "bilprov.Response", schemas.Response),
    Topic("/state", 5, JSON_ENCODING, "bilprov.State", State),
    Topic("/faults", 6, JSON_ENCODING, "foxglove.Log", schemas.Log),
    Topic(LINE, 7, JSON_ENCODING, "bilprov.Line", schemas.Line),
    Topic(CASES, 8, JSON_ENCODING, "bilprov.CaseMark", schemas.CaseMark),
    Topic(LOOKS, 9, JSON_ENCODING, "bilprov.Look", schemas.Look),
    Topic(ASKS, 10, JSON_ENCODING, "bilprov.Asked", schemas.Asked),
    Topic(CHECKPOINT, 11, JSON_ENCODING, "bilprov.Checkpoint", schemas.Checkpoint),
)

BY_VALUE = {topic.value: topic for topic in TOPICS if topic.schema}


Shapes: TypeAlias = Mapping[type, type]
"""The classes of which the values of a capture are, by the class that stands for them here."""

CAR_STATE = state_class(grammar.STATE.specs.values(), grammar.AT_REST, grammar.WHEELS)
CarLook = schemas.look_class(CAR_STATE)
CarLook.__doc__ = f"""{str(schemas.Look.__doc__).partition(chr(10))[0]}

`motion` is a value of `spec.motion.Motion`, `stopped` where the wheels stand. `speed`,
`steering` (left is negative) and `led` are what was set, whether it moves or not. `left` and
`right` are the speeds of the wheels, forward positive, in any unit.
"""
CAR_SHAPES: Shapes = {State: CAR_STATE, schemas.Look: CarLook}
_STAND_FOR: dict[type, type[msgspec.Struct]] = {
    schemas.FramedInstruction: schemas.Instruction,
    schemas.FramedResponse: schemas.Response,
}


@cache
def topic_of(kind: type[Written]) -> Topic:
    """The topic of the values of a class."""
    standing = next((base for base in (State, schemas.Look) if issubclass(kind, base)), kind)
    return BY_VALUE[_STAND_FOR.get(standing, standing)]


def encoded(value: Written) -> bytes:
    """Encode a value as the JSON of its message; fields that are None are left out."""
    items = ((key, getattr(value, name)) for key, name in _keys(type(value)))
    return msgspec.json.encode({key: item for key, item in items if item is not None})


@cache
def _keys(value: type[msgspec.Struct]) -> tuple[tuple[str, str], ...]:
    """The keys of a value's messages in order, each with the field that it has."""
    return tuple((key, field) for field in value.__struct_fields__ for key in _keys_of(field))


def _keys_of(field: str) -> tuple[str, ...]:
    return (field, BESIDE[field]) if field in BESIDE else (field,)


@cache
def json_schema(value: type[msgspec.Struct]) -> bytes:
    """The JSON Schema of a value's messages, flattened as the module's docstring says."""
    schema = msgspec.json.schema(value)
    return msgspec.json.encode(_flat(schema, schema["$defs"]))


def _flat(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return _flat(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    flat = dict(schema)
    if "anyOf" in flat:
        kinds = [kind for kind in flat.pop("anyOf") if kind.get("type") != "null"]
        if all("enum" in kind for kind in kinds):
            words = sorted(word for kind in kinds for word in kind["enum"])
            return {"type": "string", "enum": words, **flat}
        (kind,) = kinds
        if flat.get("default", "") is None:
            del flat["default"]
        return {**_flat(kind, definitions), **flat}
    if "enum" in flat:
        flat["type"] = "string"
    if flat["type"] == "object":
        flat.update(_properties(schema, definitions))
    if "description" in flat:
        flat["description"] = inspect.cleandoc(flat["description"])
    return flat


def _properties(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    required: list[str] = []
    for field, item in schema.get("properties", {}).items():
        for key in _keys_of(field):
            properties[key] = _flat(item, definitions)
            if key in TIMES:
                properties[key]["description"] = TIMES[key]
        if field in schema.get("required", ()) and {"type": "null"} not in item.get("anyOf", ()):
            required += _keys_of(field)
    return {"properties": properties, "required": required}
