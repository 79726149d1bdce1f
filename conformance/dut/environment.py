"""Environment of a run: what, besides grammar and options, is needed to repeat the run."""

from __future__ import annotations

from typing import Any

import msgspec


class Observability(msgspec.Struct, frozen=True, rename={"available": "open", "costly": "sparse"}):
    """What a probe can see: nothing (`available` false), everything, or a few looks (`costly`).

    `why` says why something is not observable. Recordings keep the fields under older names.
    """

    available: bool
    costly: bool = False
    why: str = "no probe; see --probe"


class Environment(msgspec.Struct, frozen=True, rename={"observability": "eyes"}):
    """Where and how a run takes place.

    `virtual` is true for a device object in virtual time, false for a port. `observability` says
    what can be observed, `power` whether the robot can be switched off and on. `device` and `link`
    describe the device and the link in the report only.
    """

    virtual: bool
    observability: Observability
    power: bool
    device: str
    link: dict[str, Any]
