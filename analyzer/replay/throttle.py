"""Decides when the decoded topics of a capture stop and resume, by the traffic; it has no clock."""

from __future__ import annotations

from typing import Final

SECOND: Final = 1_000_000_000  # ns
STOP_ABOVE: Final = 2_000  # host frames within a second
RESUME_BELOW: Final = STOP_ABOVE // 2  # host frames/s
RESUME_AFTER: Final = 5 * SECOND

STOPPED: Final = "decoded topics stopped"
RESUMED: Final = "decoded topics resumed"


class Throttle:
    """Counts host frames by the second. `stopped` tells whether the decoded topics are stopped.

    They stop as soon as more than 2,000 frames came within one second, which at a high rate is long
    before the second is over, and resume after 5 s in which every second had less than 1,000.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._began = 0  # of the second that is counted, ns
        self._last = 0  # when frames were last counted
        self._frames = 0
        self._calm_since = 0

    def count(self, frames: int, now: int) -> tuple[str, str] | None:
        """Count frames that came until `now` (ns); 0 lets time pass.

        When the topics stop or resume, returns which, and why in words.
        """
        ended, rate = now - self._began > SECOND, self._frames
        if ended:
            if rate >= RESUME_BELOW:
                self._calm_since = self._last
            # After a pause the second begins with what ends the pause.
            self._began = self._last if now - self._last < SECOND else now
            self._frames = 0
        self._last = now
        self._frames += frames
        if self._frames > STOP_ABOVE:
            if self.stopped:
                return None
            self.stopped = True
            return STOPPED, (
                f"{self._frames:,} host frames within a second, allowed are {STOP_ABOVE:,}: from "
                "here on the raw bytes alone are recorded (bilprov capture decode adds the rest)"
            )
        if ended and self.stopped and now - self._calm_since >= RESUME_AFTER:
            self.stopped = False
            return RESUMED, (
                f"{rate:,} host frames within a second, for {RESUME_AFTER // SECOND} s less than "
                f"{RESUME_BELOW:,}: from here on everything is recorded again"
            )
        return None
