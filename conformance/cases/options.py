"""The options of a run, as a report and a recording hold them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run; times are in milliseconds, None for the grammar's or the kit's own.

    `only` are globs of case ids in which * crosses /; none means all. `seed` governs how data and
    motions rotate through the cases. `strict` counts non-strict as failed, `fail_fast` ends the run
    after the first failure. `deadline` is how soon an answer is due: what is later is slow, what is
    later than the grammar's longest fails. `silence` is how long the line is listened to after an
    answer, `truncation_timeout` the pause that ends a frame (measured if None). `level` names the
    suite's level, `soak` how many faults more are sent at its end. `allow` are the choices
    (NAME=VALUE) that would fail otherwise. `profile` is the text of a device's profile, "" for
    none. `extra` is how many states more than the Protocol's machine a device may have that the
    level `complete` still finds. `first` are the ids of cases that are run before the others.
    """

    only: tuple[str, ...] = ()
    seed: int = 1
    strict: bool = False
    fail_fast: bool = False
    deadline: float | None = None
    silence: float | None = None
    truncation_timeout: float | None = None
    level: str = "standard"
    soak: int = 0
    allow: tuple[str, ...] = ()
    profile: str = ""
    extra: int = 0
    first: tuple[str, ...] = ()
