"""What a probe sees of the robot that is driven: asked while its port is read, and written."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Literal

import msgspec

from bilprov.analyzer.client.probes import Probe, ProbeError
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import Look

STEP = 0.5
"""Seconds of waiting at most: a signal that came just before it began is noticed then."""


def asked(
    probe: Probe,
    attend: Callable[[float, Sequence[int]], list[int]],
    stopper: Stopper,
    now: Callable[[], int] = time.monotonic_ns,
) -> Look | None:
    """Ask the probe and return what it sees, as of `now` (ns).

    `attend` waits at most some seconds for one of the descriptors, reads the port meanwhile, and
    returns those that are readable. A probe that takes long is given up when `stopper` is asked to
    stop: None. Raises ProbeError, and LinkError as `attend` does.
    """
    until = time.monotonic() + probe.patience
    probe.ask()
    while True:
        waits = probe.fileno()
        left = until - time.monotonic()
        if waits is not None and waits not in attend(min(left, STEP), [waits]):
            if stopper.stopped and probe.costly:  # a command, or a person: do not wait
                probe.close()
                return None
            if left <= 0:
                raise ProbeError(f"the probe did not answer in {probe.patience:g} s")
            continue
        look = probe.take(now())
        if look is not None:
            return look


def seen_words(look: Look | None) -> str:
    """Whether the robot was seen to move, in words; "" where nothing was seen since."""
    if look is None:
        return ""
    return {True: "seen moving", False: "seen stopped", None: "not seen"}[look.moving]


def look_words(look: Look | None) -> str:
    """All that the probe saw, in words: `seen moving: motion forward speed 80`."""
    told = _told(look).items() if look else ()
    facets = [f"{name} {value}" for name, value in told if value is not None]
    return f"{seen_words(look) or 'not observed'}{': ' if facets else ''}{' '.join(facets)}"


def look_text(look: Look, style: Literal["lines", "jsonl"]) -> str:
    """The line of a look among those of the frames; its time is in ns since their start."""
    seconds = look.t / 1e9
    if style == "lines":
        return f"{seconds:12.6f} - {look_words(look)}\n"
    line = {"t": seconds, "direction": None, "kind": "look", "moving": look.moving, **_told(look)}
    return msgspec.json.encode(line).decode() + "\n"


def _told(look: Look) -> dict[str, str | int | None]:
    """What a look tells besides whether the device moves."""
    return {name: getattr(look, name) for name in look.__struct_fields__[2:]}
