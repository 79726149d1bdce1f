"""What a fault may change of a device: the values it is made of. No behaviour of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import msgspec

from captures.schemas import Look
from spec.codec import Judgement
from spec.motion import State

if TYPE_CHECKING:
    from conformance.dut.simulator import Simulator

MS = 1_000_000


@dataclass(frozen=True, slots=True)
class Reaction:
    """What a frame brings about.

    `answers` are (delay in ns, code); `state` holds at once; `later` are states that come by
    themselves, (delay in ns, state), and `unasked` answers that do, (delay in ns, code): both only
    as long as no other frame comes.
    """

    answers: tuple[tuple[int, int], ...]
    state: State
    later: tuple[tuple[int, State], ...] = ()
    unasked: tuple[tuple[int, int], ...] = ()


class Event(msgspec.Struct, frozen=True, gc=False):
    """A frame that arrived: its judgement, the state before it, and what came before it.

    `frames` and `faults` count what came before it since power-on, `truncated` those that were cut
    short, `row` the faults in a row that ended just before it. `kind` is `instruction` or
    `truncated`, `now` when it was known to be over (ns). `previous` is the judgement of the frame
    before, `gap` the time (ns) from its end to this frame's header; both None after power-on.
    `pause` is the longest pause (ns) between two of its bytes. `pipelined` is true when its header
    came sooner than any host can that waits for the answer before.
    """

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


React = Callable[["Simulator", Event, Reaction], Reaction]
Hear = Callable[["Simulator", bytes, int], bytes]


@dataclass(frozen=True)
class Fault:
    """One named way to misbehave.

    `doc` says in a sentence what it does. `caught_by` are globs of the case ids that are meant to
    fail, `exit` the exit code of a run against it, `clauses` the fields of `spec.fields.Clauses`
    that it breaks (a case that fails names one of them), `needs` is `soak` where only very many
    frames show it. What is left out behaves well: `react` changes the reaction to a frame, `hear`
    each byte before it is framed (it may answer at once), `lengths` the data length of each header
    byte, `timeout` (ns, None for never) the pause that cuts a frame short and `timeouts` the same
    for each header byte, `whole_frame` counts it from the header on, `remains` is what stays of a
    frame that was cut short, `show` what a probe can see, `power_on` the state it starts in,
    `banner` what it sends then, `begins` what happens when a header has arrived whose data are
    still to come. `hints` are data values at which it shows, for a search. Of the past a hook knows
    what it is given and the device's `memory` alone.
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
    begins: Callable[[Simulator, int], Sequence[int]] | None = None
    clauses: tuple[str, ...] = ()
    needs: str = ""
    timeouts: Callable[[int], int | None] | None = None
    whole_frame: bool = False
    remains: Callable[[Simulator, bytes], bytes] | None = None
    banner: bytes = b""
    hints: tuple[int, ...] = ()


CONFORMING = Fault("none", "none", "behaves as the kit reads the document", exit=0)


def answers(reaction: Reaction, *codes: int, delay: int = 0) -> Reaction:
    """The reaction with other answers, `delay` ns after their time."""
    return replace(reaction, answers=tuple((delay, code) for code in codes))
