"""Finds the frame boundaries in a stream that is read from the middle on. No port, no clock.

Once the place of the first frame is known, everything after it follows from the headers, so there
are only as many possibilities as a frame has bytes. Each gets a probability from the bytes (headers
of valid instructions are far likelier than others, data within their ranges likelier than outside)
and from anchors: an answer or a pause between two frames makes a possibility more likely.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import msgspec

from bilprov.spec.protocol import Protocol

LOCKED = 1 - 1e-6
"""Probability of a frame boundary from which on it counts as certain."""

# Assumptions about a host. They matter little: with 0.6 and 0.4 for the first and the last,
# synchronising took one byte more in normal traffic and was wrong as seldom.
_VALID = 0.8  # share of headers that are those of a valid instruction
_IN_RANGE = 0.95  # share of data bytes within their field's range
_PADDING = 0.25  # share of pad bytes in the data of raw frames and of data not understood

ANSWER = 6.0
"""Likelihood ratio of an answer: how much likelier it is between two frames than within one."""
IDLE = 6.0
"""Likelihood ratio of a pause of the host that a device need not tolerate within a frame."""
SILENCE = 32.0
"""Likelihood ratio of a pause that would truncate a frame: truncated frames are rare."""


class Traffic(msgspec.Struct, frozen=True):
    """Probabilities of the bytes that a host sends, derived from a Protocol.

    `headers` has the probability of each byte as a header; `missing` that of each number of bytes
    which the current frame still needs if the stream is joined within one; `data`, by (header,
    offset), that of each byte as that data byte; `other` that of each byte as any other data byte.
    `lengths` has the number of data bytes that each header announces.
    """

    lengths: bytes
    headers: tuple[float, ...]
    missing: tuple[float, ...]
    data: Mapping[tuple[int, int], tuple[float, ...]]
    other: tuple[float, ...]


@lru_cache(maxsize=8)
def traffic(protocol: Protocol) -> Traffic:
    """Return the probabilities for a host that mostly, but not only, sends valid instructions."""
    valid = {protocol.header_bytes[s.id, s.length]: s for s in protocol.instructions}
    rest = (1 - _VALID) / max(1, 256 - len(valid))
    headers = tuple(_VALID / len(valid) if byte in valid else rest for byte in range(256))
    begun = [
        sum(headers[byte] for byte in range(256) if protocol.lengths[byte] >= count)
        for count in range(protocol.longest_frame)
    ]
    within = sum(begun[1:]) or 1.0
    other = [(1 - _PADDING) / 256] * 256
    # A device that nothing stops has no byte to pad with; zeros are common there too.
    other[protocol.pad_byte if protocol.stop_or_none else 0] += _PADDING
    return Traffic(
        lengths=protocol.lengths,
        headers=headers,
        missing=(0.0, *(share / within for share in begun[1:])),
        data={
            (byte, part.offset): tuple(
                (1 - _IN_RANGE) / 256
                + (_IN_RANGE / (part.high - part.low + 1) if part.low <= value <= part.high else 0)
                for value in range(256)
            )
            for byte, spec in valid.items()
            for part in spec.fields
            if part.size == 1
        },
        other=tuple(other),
    )


class _Possibility(msgspec.Struct):
    """One possible framing: its probability `weight` and the places where its frames begin."""

    weight: float
    missing: int
    starts: list[int] = []
    header: int | None = None
    offset: int = 0


class Synchroniser:
    """Computes the probability of each possible framing while bytes come in.

    `boundary` is the probability that the first byte is a header, `held` the number of bytes taken.
    """

    def __init__(self, traffic: Traffic, boundary: float) -> None:
        self.held = 0
        self._traffic = traffic
        self._possible = [_Possibility(boundary, 0)]
        self._possible += [
            _Possibility((1 - boundary) * share, count)
            for count, share in enumerate(traffic.missing)
            if share
        ]

    def byte(self, value: int) -> None:
        """Take the host's next byte."""
        known = self._traffic
        for one in self._possible:
            if one.missing:
                table = known.other
                if one.header is not None:
                    table = known.data.get((one.header, one.offset), table)
                one.weight *= table[value]
                one.offset += 1
                one.missing -= 1
            else:
                one.starts.append(self.held)
                one.weight *= known.headers[value]
                one.header, one.offset, one.missing = value, 0, known.lengths[value]
        self.held += 1
        self._norm()

    def anchor(self, likelihood_ratio: float) -> None:
        """Take an event that is `likelihood_ratio` times likelier between frames than within."""
        for one in self._possible:
            if not one.missing:
                one.weight *= likelihood_ratio
        self._norm()

    @property
    def locked(self) -> bool:
        """Whether some frame boundary is as good as certain (LOCKED)."""
        return max(self._shares()) >= LOCKED

    def first_frame(self, sure: float) -> int:
        """Return after how many of the held bytes the first frame begins.

        That is the first place whose probability of a boundary is at least `sure`, or else the
        highest there is. Bytes before it belong to an earlier frame, or cannot be assigned.
        """
        shares = self._shares()
        enough = min(sure, max(shares))
        return next(at for at, share in enumerate(shares) if share >= enough)

    def _shares(self) -> list[float]:
        """Return the probability of a boundary before each held byte and after the last."""
        shares = [0.0] * (self.held + 1)
        for one in self._possible:
            for start in one.starts:
                shares[start] += one.weight
            if not one.missing:
                shares[self.held] += one.weight
        return shares

    def _norm(self) -> None:
        total = sum(one.weight for one in self._possible)
        for one in self._possible:
            one.weight /= total
