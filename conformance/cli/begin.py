"""Adds to a report when and on which host the run was made, and the versions it was made with."""

from __future__ import annotations

import platform
import socket
import time
from datetime import UTC, datetime
from importlib.metadata import version

import msgspec

from bilprov.conformance.report.run_report import Report


class Begin:
    """The begin of a run: the moment at which this object is made."""

    def __init__(self) -> None:
        self._begun = datetime.now(UTC).isoformat(timespec="seconds")
        self._start = time.monotonic()

    def told(self, report: Report) -> Report:
        """The report of the run that ends now, with begin, duration, host and versions added."""
        versions = {"Python": platform.python_version(), "platform": platform.platform()}
        versions |= {name: version(name) for name in ("pyserial", "construct")}
        return msgspec.structs.replace(
            report,
            begun=self._begun,
            took_s=round(time.monotonic() - self._start, 3),
            host=socket.gethostname(),
            versions=versions,
        )
