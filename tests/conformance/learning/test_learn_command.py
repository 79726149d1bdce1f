"""`bilprov learn`: what it prints and writes, what it refuses, and that Ctrl-C stops the robot."""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support.commands import command, process, running
from tests.support.robots import at_rest, sentence, served_here, until

FAULT = "ok-to-faults-while-forward"


def test_without_graphviz_no_picture_can_be_asked_for(tmp_path: Path) -> None:
    done = command("lab", "learn", "sim", "--svg", str(tmp_path / "a.svg"), PATH=str(tmp_path))

    assert done.returncode == 2
    assert "--svg needs Graphviz (apt-get install graphviz)" in sentence(done)


@pytest.mark.slow
def test_the_shortest_difference_is_told_first_as_a_line_to_paste_and_drawn(tmp_path: Path) -> None:
    file = tmp_path / "robot.dot"

    done = command("lab", "learn", "sim", "--fault", FAULT, "--dot", str(file))

    assert done.returncode == 1
    assert "#c62828" in file.read_text()
    said = done.stdout.decode()
    first = said[said.index("\n1. ") :].splitlines()[1:5]
    assert first[0].startswith("1. Stop, 1 data byte (01 00) after Speed speed=255, Forward")
    assert first[1] == "     due: 03 TOO_MANY_DATA; stopped, led 0"
    assert first[2] == "     got: 00 OK; stopped, led 0"
    line = first[3].strip()
    assert line == "bilprov send PORT 'Speed 0' 'LED 0' 'Right 0' 'Speed 255' Forward 0100"
    assert said.splitlines()[-1] == "not the Protocol's machine"


def test_without_aalpy_one_sentence_says_how_it_comes() -> None:
    code = "import sys; sys.modules['aalpy'] = None; import bilprov; bilprov.main()"
    done = process("lab", "learn", "sim", code=code)

    assert done.returncode == 2
    expected = "learn needs AALpy, which is not installed: pip install 'bilprov[learn]'"
    assert done.stderr.decode().splitlines() == [f"bilprov: {expected}"]


@pytest.mark.waits
def test_a_robot_is_not_moved_unasked_nor_looked_at_by_a_costly_probe(protocol: Protocol) -> None:
    robot = Simulator(protocol)
    with served_here(robot, pty=True) as (port, probe):
        unasked = command("lab", "learn", port, "--probe", probe)
        costly = command("lab", "learn", port, "--probe", "exec:true", "--yes")

    assert (unasked.returncode, costly.returncode) == (2, 2)
    moves = "will move for some minutes: it drives and turns, at speeds up to 255"
    assert moves in sentence(unasked)
    assert "learning makes one after each frame" in sentence(costly)
    assert robot.frames == 0


@pytest.mark.waits
def test_an_interrupted_run_stops_the_robot_and_is_inconclusive(protocol: Protocol) -> None:
    robot = Simulator(protocol)
    with (
        served_here(robot, pty=True) as (port, probe),
        running("lab", "learn", port, "--probe", probe, "--yes") as run,
    ):
        until(lambda: robot.frames >= 1200)  # past the opening
        until(lambda: robot.state.moving)
        code, out, err = run.end()

    assert code == 3, err
    assert out.decode().splitlines()[-1] == "it was not learned to the end: interrupted"
    assert b"Traceback" not in err
    assert at_rest(robot)
