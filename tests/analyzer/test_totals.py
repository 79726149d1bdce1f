"""Totals of columns are the counts of the records, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings

from bilprov.analyzer.columns.decoder import Part, StreamDecoder
from bilprov.analyzer.columns.latencies import Latencies
from bilprov.analyzer.columns.stretch import Stretch
from bilprov.analyzer.columns.totals import SECOND, Totals
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, Event, devices, hosts
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Act, played, records_of, told

# Slow: more than make quick has time for.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


def totals(protocol: Protocol, parts: Sequence[Part]) -> Totals:
    found = Totals(protocol)
    for part in parts:
        found.add(part)
    return found


def without_none(counts: dict[str, int]) -> dict[str, int]:
    return {name: count for name, count in counts.items() if count}


def require_same(protocol: Protocol, found: Totals, records: Sequence[Record]) -> None:
    """Hold the totals against the records."""
    frames = [record for record in hosts(records) if record.judgement]
    judgements = [record.judgement for record in frames if record.judgement]
    answers = devices(records)
    names = Counter(judgement.name for judgement in judgements)
    assert without_none(found.instructions()) == names
    expected = Counter(judgement.response.name for judgement in judgements)
    assert without_none(found.expected()) == expected
    assert without_none(found.responses()) == Counter(answer.words for answer in answers)
    assert found.kinds == Counter(record.kind for record in hosts(records))
    assert found.frames == len(frames)
    assert found.host_bytes == sum(len(record.data) for record in hosts(records))
    assert found.device_bytes == len(answers)
    assert found.agreeing == sum(answer.agrees is True for answer in answers)
    assert found.disagreeing == sum(answer.agrees is False for answer in answers)
    faults = (fault.kind for record in records for fault in serious_faults(record))
    assert found.faults == Counter(faults)
    heard = [r for r in records if isinstance(r, HostRecord | DeviceRecord)]
    assert found.first == min((record.t for record in heard), default=None)
    ends = [record.end if isinstance(record, HostRecord) else record.t for record in heard]
    assert found.last == max(ends, default=None)
    seconds = Counter(record.end // SECOND for record in frames)
    assert found.peak == max(seconds.values(), default=0)

    latencies = sorted(answer.latency for answer in answers if answer.latency is not None)
    spread = found.latencies
    if not latencies:
        assert spread is None
        return
    assert spread
    assert spread.count == len(latencies)
    assert (spread.shortest, spread.longest) == (latencies[0], latencies[-1])
    exact = [latencies[len(latencies) * share // 100] for share in (50, 95, 99)]
    rounded = [max(latency // 1000 * 1000, latencies[0]) for latency in exact]
    assert [spread.median, spread.ninety_fifth, spread.ninety_ninth] == rounded


@pytest.mark.slow
@settings(max_examples=100)
@given(ACTS, BATCHES, SETTINGS)
def test_totals_are_the_counts_of_the_records(
    each_protocol: Protocol, acts: list[Act], batches: list[int], chosen: dict[str, Any]
) -> None:
    parts = told(StreamDecoder(each_protocol, **chosen), played(each_protocol, acts), batches)

    require_same(each_protocol, totals(each_protocol, parts), records_of(parts))


def answered(protocol: Protocol, count: int, seed: int) -> list[Event]:
    """Frames of random bytes, with an answer of any byte to each."""
    random, events = Random(seed), []
    for number in range(count):
        header = random.randrange(256)
        frame = bytes([header]) + random.randbytes(protocol.lengths[header])
        t = number * 200 * MS
        events.append(Chunk(t, "host", frame))
        events.append(Chunk(t + random.randrange(99 * MS), "device", random.randbytes(1)))
    return events


@pytest.mark.parametrize("heard", [{"host", "device"}, {"host"}, {"device"}])
def test_totals_of_answers_of_every_kind_are_the_counts_of_the_records(
    each_protocol: Protocol, heard: set[Any]
) -> None:
    events = answered(each_protocol, 1500, 1)
    parts = told(StreamDecoder(each_protocol, heard=frozenset(heard)), events, [400])
    found = totals(each_protocol, parts)

    assert {type(part) for part in parts} == {Stretch}
    require_same(each_protocol, found, records_of(parts))


def test_two_recordings_together_have_the_counts_of_both(protocol: Protocol) -> None:
    parts = [told(StreamDecoder(protocol), answered(protocol, 50, seed)) for seed in (1, 2)]
    one, other = (totals(protocol, each) for each in parts)
    both = totals(protocol, [*parts[0], *parts[1]])

    together = Totals(protocol)
    together.merge(one)
    together.merge(other)

    assert together.instructions() == both.instructions()
    assert together.expected() == both.expected()
    assert together.responses() == both.responses()
    assert together.latencies == both.latencies
    assert together.faults == both.faults
    assert (together.agreeing, together.disagreeing) == (both.agreeing, both.disagreeing)
    assert together.host_bytes == both.host_bytes
    assert together.peak == max(one.peak, other.peak)


def test_latencies_out_of_range_count_for_its_ends(protocol: Protocol) -> None:
    latencies = Latencies(protocol.timing)

    latencies.add([-(1 << 60), -5, 1 << 60])
    latencies.add([1_234_567])

    spread = latencies.spread
    assert spread
    assert (spread.count, spread.shortest, spread.longest) == (4, -(1 << 60), 1 << 60)
    assert spread.median == 1_234_000


def test_totals_take_no_more_memory_for_more_frames(protocol: Protocol) -> None:
    found = Totals(protocol)
    sizes = []
    for seed in range(3):
        for part in told(StreamDecoder(protocol), answered(protocol, 300, seed), [50]):
            found.add(part)
        sizes.append(sum(vars(found)[name].nbytes for name in ("_headers", "_answers")))

    assert len(set(sizes)) == 1
    assert not any(isinstance(value, list) for value in vars(found).values())
