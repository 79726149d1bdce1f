"""What bounds a run: how long it waits, and what it can see."""

from __future__ import annotations

from dataclasses import dataclass

from conformance.oracle.judge import MS


@dataclass(frozen=True, slots=True)
class Limits:
    """How long the runner waits, in ns.

    `deadline` for an answer, `longest` until a missing one is given up, `silence` after an answer
    before the next step, `hold` while a thorough case watches the stop, `grace` how much later than
    the answer a stop may be seen although it was in time (the link's own jitter), `settle` for what
    may still be under way, `boot` for the first answer, `idle` how
    long nobody talks to a robot that drives, `never` before a truncated frame counts as
    never answered. `waste` is how long in all to wait for answers that do not come, `whole`
    how long all cases may take on a slow device; None for ever.
    """

    deadline: int = 100 * MS
    longest: int = 1000 * MS
    silence: int = 20 * MS
    hold: int = 250 * MS
    grace: int = 0
    settle: int = MS
    boot: int = 10_000 * MS
    never: int = 2500 * MS
    idle: int = 1200 * MS
    waste: int | None = None
    whole: int | None = None


@dataclass(frozen=True, slots=True)
class Eyes:
    """What can be seen: nothing (`open` false), everything, or what few looks show (`sparse`).

    `why` says why something is not observable.
    """

    open: bool
    sparse: bool = False
    why: str = "no probe; see --probe"
