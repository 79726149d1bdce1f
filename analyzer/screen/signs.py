"""The signs that the screen is drawn with; `output.console` has others for narrow encodings.

What matters in a row is one of four looks, the same in every pane: a sign and a colour.
"""

from __future__ import annotations

from typing import NamedTuple

from bilprov.analyzer.decode.records import (
    DeviceRecord,
    FaultRecord,
    HostRecord,
    Record,
    serious_faults,
)
from bilprov.spec.fields import Outcome


class Look(NamedTuple):
    """How something that matters is shown: its sign, which tells it without colours too."""

    sign: str
    style: str


ORDINARY = Look(" ", "")
REFUSAL = Look("-", "yellow")
HOST_FAULT = Look("!", "bold yellow")
DEVICE_FAULT = Look("x", "bold red")
LINE_FAULT = Look("~", "cyan")
LOOKS = {
    HOST_FAULT: "fault of the host",
    DEVICE_FAULT: "fault of the device",
    LINE_FAULT: "fault of the line",
    REFUSAL: "an answer that refuses a faulty frame, as it should",
}
"""What the looks mean, for the help."""


def look_of(record: Record) -> Look:
    """The look of a row."""
    if serious_faults(record):
        if isinstance(record, HostRecord):
            return HOST_FAULT
        return DEVICE_FAULT if isinstance(record, DeviceRecord | FaultRecord) else LINE_FAULT
    answer = record.answer if isinstance(record, DeviceRecord) else None
    return REFUSAL if answer and answer.outcome is not Outcome.VALID else ORDINARY


TO_DEVICE, TO_HOST, NEITHER = "→", "←", " "
CUT, RECORDS = "…", "●"
FOLDED, UNFOLDED = "▸ ", "▾ "
