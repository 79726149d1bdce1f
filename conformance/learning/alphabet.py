"""The inputs of learning: every instruction with representative data, every kind of fault."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from bilprov.conformance.cases.frame_source import fill
from bilprov.conformance.cases.steps import Step, framed, frames_of, open_frames
from bilprov.spec.by_effect import frames_to
from bilprov.spec.codec import bad_data, judge, spaced
from bilprov.spec.protocol import InstructionSpec, Protocol


@lru_cache(maxsize=1 << 3)
def alphabet(protocol: Protocol) -> tuple[Step, ...]:
    """Every input that is learned, each frame once; a machine's inputs are their indices.

    An instruction with data comes with its first and its last, bits with names with the last but
    one; bad data are the first and the last out of range. Each instruction is also sent with a data
    byte too many and one too few. A truncated frame is a header without its data, followed by the
    time-out.
    """
    steps = [step for spec in protocol.instructions for step in _ends(protocol, spec)]
    for turn, spec in enumerate(protocol.instructions):
        for length in (spec.length - 1, spec.length + 1):
            if length in protocol.data_lengths:
                steps.append(framed(protocol, spec.id, length, fill(protocol, length, turn)))
        bad = list(bad_data(spec))
        steps += (framed(protocol, spec.id, spec.length, d) for d in (*bad[:1], *bad[-1:]))
    for turn, identity in enumerate((*protocol.unused_ids[:1], *protocol.unused_ids[-1:])):
        steps.append(framed(protocol, identity, turn, fill(protocol, turn, 1)))
    steps += open_frames(protocol).values()
    return tuple({step.frame: step for step in steps}.values())


def _ends(protocol: Protocol, spec: InstructionSpec) -> Iterator[Step]:
    """The instruction with its first and its last data."""
    steps = list(frames_of(protocol, spec.name))
    # Of bits with names not all are set: their order shows, and a bit that is stuck.
    bits = any(part.bits for part in spec.fields) and len(steps) > 2
    yield from (steps[0], steps[-2 if bits else -1])


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


def reset(protocol: Protocol) -> tuple[bytes, ...]:
    """The frames before each sequence of inputs, which bring every variable to rest.

    That is the value nearest to zero. Homing keeps what a stop keeps.
    """
    rest = {name: max(low, min(0, high)) for name, (low, high) in protocol.limits.items()}
    return frames_to(protocol, protocol.state(**{protocol.car.by: protocol.car.still}, **rest))
