"""The remembered Steps say what `codec.judge` and `Effect.apply` say, for every kind of frame."""

from __future__ import annotations

from random import Random

import pytest

from bilprov.spec.codec import judge, raw_frame
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State, after
from bilprov.spec.steps import Steps
from tests.support.car import car_state

BEFORE = car_state(speed=11, steering=-7, led=3)


def judged(protocol: Protocol, frame: bytes, state: State = BEFORE) -> State:
    """The state after a frame by the grammar's own effects."""
    judgement = judge(protocol, frame)
    effect = judgement.instruction.effect if judgement.valid and judgement.instruction else None
    return (effect or protocol.on_fault).apply(state, dict(judgement.fields))


def test_every_header_at_every_truncation_is_judged_as_by_the_grammar(
    each_protocol: Protocol,
) -> None:
    random, steps = Random(1), Steps(each_protocol)

    for header, length in enumerate(each_protocol.lengths):
        for arrived in range(length + 1):
            for _ in range(2):  # the second is one that is remembered, with other data
                frame = bytes([header]) + random.randbytes(arrived)
                step = steps[frame]
                assert step.judgement == judge(each_protocol, frame)
                assert after(BEFORE, step.sets) == judged(each_protocol, frame)
                assert steps[frame] == step


@pytest.mark.parametrize("frame", [b"", b"\x20\0"])
def test_what_is_not_one_frame_is_refused(protocol: Protocol, frame: bytes) -> None:
    with pytest.raises(ValueError, match="frame"):
        Steps(protocol)[frame]


@pytest.mark.slow
def test_no_more_frames_than_64_ki_are_remembered_and_all_are_judged_right(wide: Protocol) -> None:
    steps = Steps(wide)
    spec = next(spec for spec in wide.instructions if spec.length > 2)
    frames = [
        raw_frame(wide, spec.id, spec.length, n.to_bytes(spec.length, "big")) for n in range(70_000)
    ]

    for frame in frames:
        steps[frame]  # asking is what makes it remember

    assert len(steps) == 1 << 16
    assert steps[frames[-1]].judgement == judge(wide, frames[-1])


def test_a_frame_that_no_data_can_put_right_is_not_remembered_by_its_data(
    each_protocol: Protocol,
) -> None:
    steps, random = Steps(each_protocol), Random(3)
    unused = each_protocol.unused_ids[0]
    longest = each_protocol.data_lengths[-1]

    for _ in range(100):
        frame = raw_frame(each_protocol, unused, longest, random.randbytes(longest))
        assert steps[frame].judgement.frame == frame

    assert len(steps) == 0
