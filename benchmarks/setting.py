"""What the rows of the bench share: sizes, rounds, the protocol, the peers and a folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from benchmarks.ceiling import Ceiling
from benchmarks.peers import Construct
from benchmarks.report import OURS, Goal, Row
from benchmarks.traffic import Traffic, traffic
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.spec.protocol import Protocol


class Sizes(NamedTuple):
    """How much is measured: bytes of the host, frames, rounds, seconds."""

    columns: int  # bytes to columns
    records: int  # bytes to records
    sample: int  # bytes for construct
    rounds: int
    capture: int  # bytes through the path of `sniff -w`
    patience: float  # s for each of a row's slow parts
    replay: int  # bytes of the big capture
    line: float  # s on a full line
    fast_line: float  # s on a line of 12 Mbaud
    exchanges: int  # frames one by one
    starts: int  # starts of a command


FULL = Sizes(26_000_000, 1_700_000, 40_000, 5, 8_000_000, 5, 17_000_000, 8, 10, 1000, 21)


class Made(NamedTuple):
    """A capture that was made: how many frames it has, and its last time (ns) if that is used."""

    path: Path
    frames: int
    end: int = 0


@dataclass
class Setting:
    """One run of the bench, with a temporary folder."""

    folder: Path
    sizes: Sizes
    big: Made | None = None

    @cached_property
    def protocol(self) -> Protocol:
        """The kit's own protocol."""
        return load_protocol()

    @cached_property
    def byte_time(self) -> int:
        """Ns of a byte on the protocol's own line."""
        return line_settings(self.protocol).byte_time

    @cached_property
    def construct(self) -> Construct:
        """construct, interpreted."""
        return Construct(self.protocol)

    @cached_property
    def said(self) -> Traffic:
        """The traffic that the rows take their bytes from."""
        return traffic(self.protocol, self.sizes.columns)

    @cached_property
    def sample(self) -> Traffic:
        """Traffic for what is slow."""
        return traffic(self.protocol, 1, seed=2).first(self.protocol, self.sizes.sample)

    @cached_property
    def ceiling(self) -> Ceiling:
        """The C loop."""
        return Ceiling(self.protocol, self.folder, len(self.said.host))

    def new_file(self, name: str) -> Path:
        """A path at which there is no file."""
        path = self.folder / name
        path.unlink(missing_ok=True)
        return path


class Work(NamedTuple):
    """One row to measure: its name, what it is in words, and the function that measures it."""

    name: str
    words: str
    measure: Callable[[Setting, Work], Row]

    def row(
        self,
        work: str,
        unit: str,
        measured: Mapping[str, float],
        *goals: Goal,
    ) -> Row:
        """Its row; `measured` has the figure of bilprov and those of the peers."""
        peers = dict(measured)
        ours = peers.pop(OURS)
        return Row(self.name, work, unit, ours, peers, goals)
