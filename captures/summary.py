"""What a capture holds in numbers, for `bilprov info`; nothing is read again."""

from __future__ import annotations

from dataclasses import dataclass

from captures.reader import Capture
from captures.topics import DEVICE_RAW, HOST_RAW


@dataclass(frozen=True, slots=True)
class Summary:
    """Numbers of one capture.

    `counts` gives messages by topic, topics without a message included, in the order of their
    names (foreign text: show it only through `errors.shown`). `duration` is ns from the capture's
    start to its last message, 0 without one; `host_bytes` and `device_bytes` count raw bytes.
    """

    counts: tuple[tuple[str, int], ...]
    messages: int
    duration: int
    host_bytes: int
    device_bytes: int


def summary(capture: Capture) -> Summary:
    """The numbers of a capture as they were found when it was opened."""
    contents = capture.contents
    return Summary(
        counts=tuple(sorted(contents.counts.items())),
        messages=sum(contents.counts.values()),
        duration=max(0, contents.last - capture.start),
        host_bytes=contents.sizes.get(HOST_RAW, 0),
        device_bytes=contents.sizes.get(DEVICE_RAW, 0),
    )
