"""What a run is said to make the robot do is what it makes it do: no other motion, no faster."""

from __future__ import annotations

import pytest

from bilprov.conformance.api import Options, conform, select_cases
from bilprov.conformance.cases.budget import run_movement
from bilprov.conformance.dut.fault import Event, Fault, Reaction
from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.by_effect import Movement
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol


class Driven(Simulator):
    """A robot that notes in which motions, and how fast at most, it was told to drive."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol, Fault("noting", "test", "", react=self._note))
        self.done = Movement()

    def _note(self, device: object, event: Event, reaction: Reaction) -> Reaction:
        after = reaction.state
        if after.motion != Motion.STOPPED:
            self.done |= Movement(frozenset({after.motion}), after.speed)
        return reaction


class Unseen:
    """A robot without a probe."""

    def __init__(self, robot: Simulator) -> None:
        self.receive, self.advance, self.deadline = robot.receive, robot.advance, robot.deadline


@pytest.mark.parametrize(
    "options",
    [
        Options(only=("valid/Stop",)),
        Options(only=("valid/Speed/*",)),
        Options(only=("bad-data/LED/*",)),
        Options(only=("split/*",)),
        pytest.param(Options(level="smoke"), marks=pytest.mark.slow),
        pytest.param(Options(soak=50, level="smoke"), marks=pytest.mark.slow),
    ],
    ids=lambda options: f"{options.level} {' '.join(options.only)} {options.soak}",
)
@pytest.mark.parametrize("looks", [True, False])
def test_a_run_drives_as_it_said(protocol: Protocol, options: Options, looks: bool) -> None:
    said = run_movement(protocol, select_cases(protocol, options), looks=looks)
    robot = Driven(protocol)

    report = conform(
        robot if looks else Unseen(robot),  # type: ignore[arg-type]  # it has no look
        grammar=protocol,
        options=options,
    )

    assert report.exit in (0, 3)
    assert robot.done.motions <= said.motions
    assert (robot.done.speed or 0) <= (said.speed or 0)
    assert robot.done == said
