"""For every grammar that the loader accepts the simulator conforms, or the loader refuses it.

The grammars are drawn by seed: 3 of them in each run, a thousand with --whole. All that
load must conform; only those that declare what the kit cannot hold are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import pytest
from msgspec.structs import replace

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import build, judge
from bilprov.spec.protocol import GrammarError, Protocol, load
from bilprov.spec.state import Effect, From, State
from tests.support.drawn_grammars import Drawn, drawn

pytestmark = pytest.mark.slow

CHUNK = 3
CHUNKS = [range(start, start + CHUNK) for start in range(0, 1000, CHUNK)]


def smoke(protocol: Protocol, device: Simulator | None = None) -> Report:
    return conform(device, grammar=protocol, options=Options(level="smoke"), logged=False)


def loaded(one: Drawn) -> Protocol | str:
    """The protocol of a drawn grammar, or the sentence that refuses it."""
    try:
        return load(one.text, f"drawn-{one.seed}.py")
    except GrammarError as error:
        return str(error)


def protocols(seeds: range) -> Iterator[Protocol]:
    """Those of these seeds that load."""
    yield from (p for p in map(loaded, map(drawn, seeds)) if isinstance(p, Protocol))


def frames(protocol: Protocol) -> list[bytes]:
    """Each instruction with its lowest and its highest data."""
    return [
        build(protocol, spec.name, {f.name: getattr(f, end) for f in spec.fields})
        for spec in protocol.instructions
        for end in ("low", "high")
    ]


def can_move(protocol: Protocol) -> bool:
    """Whether two instructions set it moving, from a stop after power-on and after a fault."""
    stop, fault = protocol.stop.effect, protocol.on_fault
    return all(
        _moves_from(protocol, stop.apply(state))
        for state in (protocol.power_on, fault.apply(protocol.power_on))
    )


def _moves_from(protocol: Protocol, start: State) -> bool:
    states = {start}
    for _ in range(2):
        states |= {moved(protocol, state, frame) for state in states for frame in frames(protocol)}
    return any(state.moving for state in states)


def moved(protocol: Protocol, state: State, frame: bytes) -> State:
    judged = judge(protocol, frame)
    assert judged.instruction is not None
    return judged.instruction.effect.apply(state, dict(judged.fields))


@pytest.mark.sample(1)
@pytest.mark.parametrize("seeds", CHUNKS, ids=str)
def test_the_simulator_of_each_drawn_grammar_conforms(seeds: range) -> None:
    conforming = 0
    for seed in seeds:
        one = drawn(seed)
        protocol = loaded(one)
        if isinstance(protocol, str):
            assert one.refused, protocol
            assert f": {one.refused}" in protocol
            continue
        assert not one.refused, seed
        report = smoke(protocol)
        # Nothing fails, and where it moves everything can be judged.
        assert report.exit in ((0,) if can_move(protocol) else (0, 3)), (seed, report.counts)
        conforming += report.exit == 0
    assert conforming


def other_source(protocol: Protocol, fault: str) -> str:
    """A text by which the protocol is another one to what remembers protocols."""
    return f"{protocol.source}# {fault}\n"


def never_stops(protocol: Protocol) -> Protocol:
    """The protocol of a robot that a faulty instruction does not stop."""
    return replace(protocol, on_fault=Effect(), source=other_source(protocol, "never stops"))


def doubles(protocol: Protocol, variable: str) -> Protocol | None:
    """The protocol of a robot that doubles what it is told; None if it can be told nothing."""
    if not any(protocol.limits.get(variable, ())):
        return None
    instructions = tuple(
        replace(
            spec, effect=Effect(tuple(_doubled(variable, *one) for one in spec.effect.assignments))
        )
        for spec in protocol.instructions
    )
    source = other_source(protocol, f"doubles {variable}")
    return replace(protocol, instructions=instructions, source=source)


def _doubled(variable: str, name: str, value: object) -> tuple[str, object]:
    if name == variable and isinstance(value, From):
        return name, replace(value, factor=2 * value.factor)
    return name, 2 * value if name == variable and isinstance(value, int) else value


@pytest.mark.sample(1)
@pytest.mark.parametrize("seeds", CHUNKS, ids=str)
def test_a_fault_in_the_device_of_a_drawn_grammar_fails(seeds: range) -> None:
    tried = 0
    for protocol in islice(filter(can_move, protocols(seeds)), 2):
        for faulty in (never_stops(protocol), doubles(protocol, "speed"), doubles(protocol, "led")):
            if faulty is not None:
                tried += 1
                assert smoke(protocol, Simulator(faulty)).exit == 1, protocol.version
    assert tried
