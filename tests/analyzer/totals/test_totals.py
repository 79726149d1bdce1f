"""Totals of columns are the counts of the records, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.json_lines import json_line
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record, serious_faults
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.filters.filter import compile_filter
from bilprov.analyzer.totals.totals import (
    BUCKETS,
    SECOND,
    SERIES,
    Bin,
    Latencies,
    Rates,
    Spread,
    Totals,
)
from bilprov.captures.schemas import Chunk
from bilprov.spec.protocol import Protocol, load
from tests.support.decoding import MS, Event, devices, hosts
from tests.support.framed_traffic import FRAMED, Traffic, exchanges
from tests.support.traffic import ACTS, BATCHES, SETTINGS, Acts, played, records_of, told

# Slow: more than make quick has time for.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("columns_at_once")]


def totals(protocol: Protocol, batches: Sequence[Batch]) -> Totals:
    found = Totals(protocol)
    for batch in batches:
        found.add(batch)
    return found


def without_none(counts: dict[str, int]) -> dict[str, int]:
    return {name: count for name, count in counts.items() if count}


def require_same(protocol: Protocol, found: Totals, records: Sequence[Record]) -> None:
    """Hold the totals against the records."""
    frames = [record for record in hosts(records) if record.judgement]
    judgements = [record.judgement for record in frames if record.judgement]
    answers = devices(records)
    names = Counter(judgement.name for judgement in judgements)
    by_name = found.instructions()
    assert without_none({name: one.frames for name, one in by_name.items()}) == names
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
    assert found.faults_of() == Counter(faults)
    for side in ("host", "device", ""):
        faults = (f.kind for r in records if direction(r) == side for f in serious_faults(r))
        assert found.faults_of(side) == Counter(faults)
    heard = [r for r in records if isinstance(r, HostRecord | DeviceRecord)]
    assert found.first == min((record.t for record in heard), default=None)
    ends = [record.end if isinstance(record, HostRecord) else record.t for record in heard]
    assert found.last == max(ends, default=None)
    seconds = Counter(record.end // SECOND for record in frames)
    assert found.peak == max(seconds.values(), default=0)

    pairs = [(answer, answer.answered) for answer in answers if answer.answered]
    for name, one in by_name.items():
        mine = [answer for answer, to in pairs if to.name == name]
        assert one.responses == Counter(answer.words for answer in mine)
        odd = [*mine, *(record for record in frames if record.judgement.name == name)]
        assert one.faults == Counter(f.kind for record in odd for f in serious_faults(record))
        require_spread(one.latencies, [answer.latency for answer in mine])
    require_spread(found.latencies.spread(), [answer.latency for answer, _ in pairs])
    require_bins(found.latencies.histogram(), [answer.latency for answer, _ in pairs])
    require_rates(found.rates, records)


def direction(record: Record) -> str:
    """Whose record it is, as its JSON line says."""
    line = json_line(record)
    return (line and line.direction) or ""


def require_spread(spread: Spread | None, latencies: list[Any]) -> None:
    if not latencies:
        assert spread is None
        return
    latencies.sort()
    assert spread
    assert spread.count == len(latencies)
    assert (spread.min, spread.max) == (latencies[0], latencies[-1])
    rounded = [max(latency // 1000 * 1000, latencies[0]) for latency in latencies]
    exact = np.percentile(rounded, [50, 95, 99])
    assert [spread.median, spread.p95, spread.p99] == pytest.approx(exact, abs=1)


def require_bins(bins: list[Bin], latencies: list[Any]) -> None:
    assert len(bins) <= 12
    # What is earlier than 100 ms before its instruction counts there.
    latencies = [max(latency, -100_000_000) for latency in latencies]
    for start, stop, amount in bins:
        assert amount == sum(start <= latency < stop for latency in latencies)
    assert sum(one.amount for one in bins) == len(latencies)
    assert all(one.stop == other.start for one, other in pairwise(bins))
    assert len({stop - start for start, stop, _ in bins[:-1]}) <= 1


def require_rates(rates: Rates, records: Sequence[Record]) -> None:
    counts: dict[str, Counter[int]] = {name: Counter() for name in SERIES}
    for record in records:
        if isinstance(record, HostRecord):
            counts["host_bytes"][bucket(rates, record.end)] += len(record.data)
            counts["frames"][bucket(rates, record.end)] += record.judgement is not None
        elif isinstance(record, DeviceRecord):
            counts["device_bytes"][bucket(rates, record.t)] += 1
        for fault in serious_faults(record):
            counts["faults"][bucket(rates, fault.t)] += 1
    for name in SERIES:
        assert Counter(dict(enumerate(rates.series(name)))) == counts[name]


def bucket(rates: Rates, t: int) -> int:
    return max(0, t - rates.start) // rates.width


def moved(protocol: Protocol, records: Sequence[Record], first: int, last: int) -> int:
    """For how long (ns) the wheels turn between two times, added up record by record."""
    now, moving, total = first, protocol.power_on.moving, 0
    for record in hosts(records):
        t = min(max(record.known, first), last)
        total += moving * max(0, t - now)
        now, moving = max(now, t), record.state.moving
    return total + moving * max(0, last - now)


FILTERS = (
    "faulty",
    "direction == host",
    "state.moving and t > 0.1",
    "latency > 0.02",
    "kind == gap",
)


@pytest.mark.sample(1)
@pytest.mark.slow
@given(ACTS, BATCHES, SETTINGS, st.none() | st.sampled_from(FILTERS))
def test_totals_are_the_counts_of_the_records_that_pass_a_filter_if_there_is_one(
    each_protocol: Protocol,
    acts: Acts,
    batches: list[int],
    chosen: dict[str, Any],
    expression: str | None,
) -> None:
    parts = told(StreamDecoder(each_protocol, **chosen), played(each_protocol, acts), batches)
    found, records = Totals(each_protocol), records_of(parts)
    passing = records
    if expression is None:
        found = totals(each_protocol, parts)
    else:
        test, everything = compile_filter(expression, each_protocol), Records(records)
        passing = list(everything.records(test.selection(everything)))
        for part in parts:
            found.add(part, test.selection(part))

    require_same(each_protocol, found, passing)
    if found.first is not None and found.last is not None:
        assert found.moving == moved(each_protocol, records, found.first, found.last)


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
    assert together.latencies.spread() == both.latencies.spread()
    assert together.latencies.histogram() == both.latencies.histogram()
    assert together.faults_of() == both.faults_of()
    assert (together.agreeing, together.disagreeing) == (both.agreeing, both.disagreeing)
    assert together.host_bytes == both.host_bytes
    assert together.peak == max(one.peak, other.peak)


def test_latencies_out_of_range_count_for_its_ends(protocol: Protocol) -> None:
    latencies = Latencies(protocol.timing)

    latencies.add([-(1 << 60), -5, 1 << 60])
    latencies.add([1_234_567])

    spread = latencies.spread()
    assert spread
    assert (spread.count, spread.min, spread.max) == (4, -(1 << 60), 1 << 60)
    assert spread.median == (1_234_000 - 1_000) // 2  # the mean of the middle two


def test_totals_take_no_more_memory_for_more_frames(protocol: Protocol) -> None:
    found = Totals(protocol)
    sizes = []
    for seed in range(3):
        for part in told(StreamDecoder(protocol), answered(protocol, 300, seed), [50]):
            found.add(part)
        sizes.append(vars(found)["_headers"].nbytes)

    assert len(set(sizes)) == 1
    assert len(vars(found)["_answers"]) <= 256
    assert not any(isinstance(value, list) for value in vars(found).values())


def test_counts_by_time_are_bounded_however_long_a_recording_is() -> None:
    rates, times = Rates("frames"), [5 * SECOND, 6 * SECOND, 7000 * SECOND, 1 << 62]

    for t in times:
        rates.count("frames", np.array([t]))
    rates.count("frames", np.array([8 * SECOND, 7000 * SECOND]))

    assert rates.width > SECOND
    assert BUCKETS // 2 <= len(rates.series("frames")) <= BUCKETS
    assert sum(rates.series("frames")) == len(times) + 2


@pytest.mark.parametrize("steps", [[0.5], [1000], [5, 1025], [3, 700, 1029, 5000]])
def test_wider_steps_hold_what_the_narrow_ones_held(steps: list[float]) -> None:
    times = np.array([round((3 + step) * SECOND) for step in steps], np.int64)
    one, other = Rates("frames"), Rates("frames")
    one.count("frames", times, np.arange(1, len(steps) + 1))
    for amount, t in enumerate(times.tolist(), 1):
        other.count("frames", np.array([t]), np.array([amount]))

    assert (one.start, one.width) == (other.start, other.width)
    assert one.series("frames") == other.series("frames")


@pytest.mark.parametrize("grammar", FRAMED)
@pytest.mark.parametrize("odd", [0.0, 0.5])
def test_only_answers_that_are_due_are_expected(grammar: str, odd: float) -> None:
    protocol = load(FRAMED[grammar])
    events = exchanges(protocol, Random(1), 60, Traffic(odd=odd))
    batches = told(StreamDecoder(protocol), events, [len(events)])
    judged = [record.judgement for record in hosts(records_of(batches)) if record.judgement]
    due = Counter(one.response.name for one in judged if one.answer_due)
    found = totals(protocol, batches)
    assert without_none(found.expected()) == due
    if not odd:
        assert without_none(found.responses()) == due
