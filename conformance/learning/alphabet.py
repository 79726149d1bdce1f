"""The inputs of learning: every instruction with representative data, every kind of fault."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from bilprov.conformance.cases.frame_source import fill
from bilprov.conformance.cases.steps import (
    Step,
    bad_data_frame,
    open_frames,
    unused_id_frame,
    valid_frame,
    wrong_length_frame,
)
from bilprov.conformance.oracle.state_model import VARIABLES
from bilprov.spec.by_effect import setting
from bilprov.spec.codec import all_data, bad_data, build, judge, spaced
from bilprov.spec.protocol import InstructionSpec, Protocol


@lru_cache(maxsize=1 << 3)
def alphabet(protocol: Protocol) -> tuple[Step, ...]:
    """Every input that is learned, each frame once; a machine's inputs are their indices.

    An instruction with data comes with its first and its last, bits with names with the last but
    one; bad data are the first and the last out of range. Each instruction is also sent with a data
    byte too many and one too few. A truncated frame is a header without its data, followed by the
    time-out.
    """
    steps = [step for spec in protocol.instructions for step in _valid(protocol, spec)]
    for turn, spec in enumerate(protocol.instructions):
        steps += _faulty(protocol, spec, turn)
    if protocol.unused_ids:
        steps.append(unused_id_frame(protocol, protocol.unused_ids[0], 0, b""))
        last = protocol.unused_ids[-1]
        steps.append(unused_id_frame(protocol, last, 1, fill(protocol, 1, 1)))
    steps += open_frames(protocol).values()
    return tuple({step.frame: step for step in steps}.values())


def _valid(protocol: Protocol, spec: InstructionSpec) -> Iterator[Step]:
    data = list(all_data(spec))
    # Of bits with names not all are set: their order shows, and a bit that is stuck.
    bits = any(part.bits for part in spec.fields) and len(data) > 2
    for some in dict.fromkeys((data[0], data[-2 if bits else -1])):
        yield valid_frame(protocol, spec, spec.decode(some))


def _faulty(protocol: Protocol, spec: InstructionSpec, turn: int) -> Iterator[Step]:
    for length in (spec.length - 1, spec.length + 1):
        if length in protocol.data_lengths:
            data = fill(protocol, length, turn)
            yield wrong_length_frame(protocol, spec, length, data)
    bad = list(bad_data(spec))
    for some in dict.fromkeys((*bad[:1], *bad[-1:])):
        yield bad_data_frame(protocol, spec, some)


def name_of(protocol: Protocol, step: Step) -> str:
    """An input in words: `Speed speed=255`, `unused 9, 2 data bytes (92 00 00)`."""
    words = judge(protocol, step.frame).describe()
    return f"{words} ({spaced(step.frame)})" if step.faulty and len(step.frame) > 1 else words


def item_of(protocol: Protocol, frame: bytes) -> str:
    """A frame as `bilprov send` takes it: an instruction with its values, else hex."""
    judged = judge(protocol, frame)
    if not judged.valid:
        return frame.hex()
    return " ".join((judged.name, *(str(value) for _, value in judged.fields)))


@lru_cache(maxsize=1 << 3)
def reset(protocol: Protocol) -> tuple[bytes, ...]:
    """The frames before each sequence of inputs, which bring every variable to rest.

    That is the value nearest to zero, or, where only a motion instruction sets it, what the lowest
    data of that give; a stop follows. Homing keeps what a stop keeps.
    """
    stop = bytes([protocol.pad_byte])
    driving: list[bytes] = []
    settings: list[bytes] = []
    for variable in VARIABLES:
        if variable not in protocol.limits:
            continue
        low, high = protocol.limits[variable]
        frame = setting(protocol, variable, max(low, min(0, high)))
        setters = (s for s in protocol.instructions if s.fields and s.effect.sets(variable))
        if frame:
            settings.append(frame)
        elif spec := next(setters, None):
            driving += [build(protocol, spec.name, {f.name: f.low for f in spec.fields}), stop]
    return (*driving, *settings)
