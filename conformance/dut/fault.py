"""The value types of a fault: the hooks with which it changes a device, and what they are given."""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec

from bilprov.captures.schemas import Look
from bilprov.spec.codec import Judgement
from bilprov.spec.protocol import Protocol
from bilprov.spec.state import State


@dataclass(frozen=True, slots=True)
class Reaction:
    """How a device reacts to a frame: its answers and its states.

    `answers` are (delay in ns, code); `state` holds at once. `later` are states that follow by
    themselves, (delay in ns, state), and `unasked` answers that do, (delay in ns, code): both are
    dropped when another frame comes.
    """

    answers: tuple[tuple[int, int], ...]
    state: State
    later: tuple[tuple[int, State], ...] = ()
    unasked: tuple[tuple[int, int], ...] = ()


class Event(msgspec.Struct, frozen=True, gc=False):
    """A frame that arrived, with its judgement, the state before it, and the frames before it.

    `frames` and `faults` count the frames before it since power-on, `truncated` the truncated ones,
    `row` the consecutive faults right before it. `kind` is `instruction` or `truncated`, `now` the
    time (ns) when the frame was over. `previous` is the judgement of the frame before, `gap` the
    time (ns) from its end to this frame's header; both None after power-on. `pause` is the longest
    pause (ns) between two of its bytes. `pipelined` is true when its header came too soon for a
    host that waits for the previous answer.
    """

    protocol: Protocol
    judgement: Judgement
    before: State
    frames: int
    faults: int
    kind: str
    now: int
    truncated: int = 0
    row: int = 0
    previous: Judgement | None = None
    previous_kind: str = ""
    gap: int | None = None
    pause: int = 0
    pipelined: bool = False


class MutatedDevice(typing.Protocol):
    """The part of a device that the hooks of its fault may read and change.

    `byte_time` is a byte's time on the line (ns), `over_at` when the frame before was over (ns,
    None after power-on); `faults` and `row` count as in Event. `timeouts` are the pauses (ns, None
    for never) that truncate a frame, by its header.
    """

    protocol: Protocol
    fault: Fault
    state: State
    memory: dict[str, int]
    byte_time: int
    over_at: int | None
    faults: int
    row: int
    timeouts: Sequence[int | None]
    step: Callable[[bytes, State], tuple[Judgement, State]]

    @property
    def held(self) -> bytes:
        """The bytes of the frame that is not complete yet."""

    def answer(self, code: int, at: int) -> None:
        """Queue an answer byte for the time `at` (ns)."""

    def drop(self) -> None:
        """Discard the incomplete frame: the next byte is a header."""

    def react_at_header(self, frame: bytes, now: int) -> None:
        """React at `now` (ns) to a frame of which only the header has come."""


class Trigger(typing.Protocol):
    """The frames at which a fault shows."""

    def holds(self, event: Event, memory: dict[str, int]) -> bool:
        """Whether the device misbehaves at this frame; `memory` is the trigger's, over a run."""


React = Callable[[MutatedDevice, Event, Reaction], Reaction]
Hear = Callable[[MutatedDevice, bytes, int], bytes]


@dataclass(frozen=True)
class Fault:
    """One named deviation of a device from the document.

    `doc` says in a sentence what it does. `caught_by` are globs of the case ids that are meant to
    fail, `exit` the exit code of a run against it, `clauses` the fields of `spec.fields.Clauses`
    that it breaks (a case that fails names one of them), `needs` is `soak` where only very many
    frames show it. Each other field is a hook or a setting; one left out conforms: `react` changes
    the reaction to a frame, `hear` each byte before it is framed (it may answer at once), `lengths`
    the data length of each header byte, `timeout` (ns, None for never) the pause that truncates a
    frame and `timeouts` the same for each header byte, `whole_frame` counts it from the header on,
    `remains` gives the bytes kept of a truncated frame, `show` changes what a probe sees,
    `power_on` is the state at power-on, `banner` the bytes sent then, `begins` gives the codes
    answered to a header whose data are still to come. A hook knows of the past only its arguments
    and the device's `memory`. The hooks are made of `trigger` and the words `what`.
    """

    name: str
    family: str
    doc: str
    caught_by: tuple[str, ...] = ()
    exit: int = 1
    react: React | None = None
    hear: Hear | None = None
    lengths: Sequence[int] | None = None
    timeout: int | str | None = "default"
    show: Callable[[Look], Look] | None = None
    power_on: State | None = None
    begins: Callable[[MutatedDevice, int], Sequence[int]] | None = None
    clauses: tuple[str, ...] = ()
    needs: str = ""
    timeouts: Callable[[int], int | None] | None = None
    whole_frame: bool = False
    remains: Callable[[MutatedDevice, bytes], bytes] | None = None
    banner: bytes = b""
    trigger: Trigger | None = None
    what: str = ""


CONFORMING = Fault("none", "none", "behaves as the kit reads the document", exit=0)


def answers(reaction: Reaction, *codes: int, delay: int = 0) -> Reaction:
    """The reaction with other answers, `delay` ns after their time."""
    return replace(reaction, answers=tuple((delay, code) for code in codes))
