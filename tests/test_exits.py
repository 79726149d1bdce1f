"""Whatever ends a command that drives, in whatever phase, the robot is left at rest."""

from __future__ import annotations

import signal

import pytest

from benchmarks.torture import exits
from benchmarks.torture.exits import CASES, COMMANDS, DRIVING, PHASES, WAYS, Case, ended

pytestmark = [pytest.mark.waits, pytest.mark.slow]


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    "case", [case for case in CASES if case[1] in DRIVING], ids=lambda case: "-".join(case)
)
def test_a_command_that_is_ended_while_it_drives_stops_the_robot(case: Case) -> None:
    left = ended(case, seed=1)

    assert left.held, left


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    "case", [case for case in CASES if case[1] not in DRIVING], ids=lambda case: "-".join(case)
)
def test_a_command_that_is_ended_before_or_after_leaves_the_robot_at_rest(case: Case) -> None:
    left = ended(case, seed=1)

    assert left.held, left


@pytest.mark.sample(2)
@pytest.mark.parametrize("case", exits.SIGNAL_CASES, ids=lambda case: "-".join(case))
def test_every_signal_that_can_be_handled_stops_the_robot_first(case: Case) -> None:
    left = ended(case, seed=1)

    assert left.held, left


def test_a_kill_is_seen_to_leave_the_robot_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing follows a SIGKILL: this is what the other tests would see of a stop that fails."""
    kill = exits._signals(signal.SIGKILL)
    monkeypatch.setitem(WAYS, "SIGKILL", kill)

    left = ended(("send", "in a pause", "SIGKILL"), seed=1)

    assert left.moved
    assert left.left_moving
    assert not left.held


def test_each_command_that_drives_is_in_each_phase_and_way() -> None:
    rows = {name: [case for case in CASES if case[0] == name] for name in COMMANDS}

    assert rows.pop(exits.EXAMINES)
    assert {len(found) for found in rows.values()} == {len(PHASES) * len(WAYS)}


SUSPENDED = """
import sys, time
from bilprov.analyzer.transport.ports import open_port
port = open_port(sys.argv[1])
for frame in sys.argv[2:]:
    port.write(bytes.fromhex(frame))
time.sleep(60)
"""


def test_a_command_that_is_suspended_while_its_robot_moves_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(exits.SIGNALLED, "planted", exits._driver(SUSPENDED))

    left = ended(("planted", "while moving", "SIGTSTP"), seed=1)

    assert left.moved
    assert left.left_moving


def test_every_signal_is_sent_to_every_command_in_every_phase_in_which_it_drives() -> None:
    assert len(set(exits.SIGNAL_CASES)) == 8 * len(DRIVING) * 19
    assert set(exits.SIGNALS) > {"SIGQUIT", "SIGTSTP", "SIGXCPU", "SIGRTMIN", "SIGRTMAX"}
