"""Where frames begin in a stream that was joined in its midst. No port, no clock.

Once it is said where the first frame begins, everything after it follows from the headers: so there
are only as many possibilities as a frame has bytes. Each is weighed by the bytes (headers of valid
instructions are far likelier than others, data within their ranges likelier than outside) and by
soft anchors: an answer, or a pause, that falls between two frames speaks for the possibility.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

from spec.protocol import Protocol

LOCKED = 1 - 1e-6
"""How sure it must be that a frame begins at some place, so that all that follows is known."""

# What is assumed of a host. These matter little: with 0.6 and 0.4 for the first and the last it
# took one byte more in normal traffic and was wrong as seldom.
_VALID = 0.8  # share of headers that are those of a valid instruction
_IN_RANGE = 0.95  # share of data bytes within their field's range
_PADDING = 0.25  # share of the data of lying frames, and of data not understood, that is filler

ANSWER = 6.0
"""How much likelier an answer is between two frames than within one."""
IDLE = 6.0
"""The same for a pause of the host that a device need not bear within a frame."""
SILENCE = 32.0
"""The same for a pause that ends a frame: one that is cut short is rare."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """What bytes a host is likely to send: probabilities, read out of a Protocol.

    `headers` of each byte as a header, `missing` of each number of bytes that the frame under way
    still lacks where the stream is joined within one, `data` of each byte as the data byte at an
    offset after a header, `other` of each byte as any other data byte.
    """

    lengths: bytes
    headers: tuple[float, ...]
    missing: tuple[float, ...]
    data: Mapping[tuple[int, int], tuple[float, ...]]
    other: tuple[float, ...]


@lru_cache(maxsize=8)
def traffic(protocol: Protocol) -> Traffic:
    """What a host that speaks the protocol, not without faults, is likely to send."""
    valid = {protocol.header_bytes[s.id, s.length]: s for s in protocol.instructions}
    rest = (1 - _VALID) / max(1, 256 - len(valid))
    headers = tuple(_VALID / len(valid) if byte in valid else rest for byte in range(256))
    begun = [
        sum(headers[byte] for byte in range(256) if protocol.lengths[byte] >= count)
        for count in range(protocol.longest_frame)
    ]
    within = sum(begun[1:]) or 1.0
    other = [(1 - _PADDING) / 256] * 256
    other[protocol.filler] += _PADDING
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


@dataclass(slots=True)
class _Possibility:
    """The first frame begins after `starts[0]` bytes; what follows from it."""

    weight: float
    missing: int
    starts: list[int] = field(default_factory=list)
    header: int | None = None
    offset: int = 0


class Synchroniser:
    """Weighs the possibilities while bytes come in; `held` counts them.

    `boundary` is how likely the first byte is a header.
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
        """The host's next byte."""
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
        """Something happened that is so much likelier between two frames than within one."""
        for one in self._possible:
            if not one.missing:
                one.weight *= likelihood_ratio
        self._norm()

    @property
    def locked(self) -> bool:
        """Whether it is as good as certain that a frame begins at some place."""
        return max(self._shares()) >= LOCKED

    def first_frame(self, sure: float) -> int:
        """After how many of the bytes held the first frame begins.

        That is the first place that is as sure to be one where a frame begins, or as sure as any.
        Bytes before it belong to a frame begun earlier, or nobody can tell.
        """
        shares = self._shares()
        enough = min(sure, max(shares))
        return next(at for at, share in enumerate(shares) if share >= enough)

    def _shares(self) -> list[float]:
        """How sure it is that a frame begins at each place, from 0 to after the last byte held."""
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
