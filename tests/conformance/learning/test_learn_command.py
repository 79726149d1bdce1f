"""`bilprov learn`: what it prints and writes, what it refuses, and that Ctrl-C stops the robot."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bilprov.conformance.dut.simulator import Simulator
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.commands import command, process
from tests.support.firmware import needs
from tests.support.robots import PATIENCE, at_rest, sentence, served_here

FAULT = "ok-to-faults-while-forward"


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """What is printed and the drawing of one faulty robot."""
    folder = tmp_path_factory.mktemp("learned")
    file = folder / "robot.dot"

    done = command("lab", "learn", "sim", "--fault", FAULT, "--dot", str(file))

    assert done.returncode == 1
    return done.stdout.decode(), file.read_text()


def test_without_graphviz_no_picture_can_be_asked_for(tmp_path: Path) -> None:
    done = command("lab", "learn", "sim", "--svg", str(tmp_path / "a.svg"), PATH=str(tmp_path))

    assert done.returncode == 2
    assert "--svg needs Graphviz (apt-get install graphviz)" in sentence(done)


@pytest.mark.slow
def test_the_shortest_difference_is_told_first_as_a_line_to_paste(
    learned: tuple[str, str],
) -> None:
    said, _ = learned

    first = said[said.index("\n1. ") :].splitlines()[1:5]
    assert first[0].startswith("1. Stop, 1 data byte (01 00) after Speed speed=255, Forward")
    assert first[1] == "     due: 03 TOO_MANY_DATA; stopped, led 0"
    assert first[2] == "     got: 00 OK; stopped, led 0"
    line = first[3].strip()
    assert line == "bilprov send PORT 'Speed 0' 'LED 0' 'Right 0' 'Speed 255' Forward 0100"
    assert said.splitlines()[-1] == "not the Protocol's machine"


@pytest.mark.slow
def test_the_drawing_has_the_kinds_of_motion_and_what_differs(
    learned: tuple[str, str],
) -> None:
    _, text = learned

    assert text.startswith('digraph "sim" {')
    assert '[label="stopped\\n' in text
    assert "#c62828" in text


@needs("dot", package="graphviz")
@pytest.mark.waits
def test_with_graphviz_it_is_drawn(tmp_path: Path) -> None:
    from bilprov.conformance.learning.drawing import svg_text

    picture = svg_text('digraph "a" { 0 -> 1 [label="2 inputs"]; }')
    assert "<svg" in picture
    assert "2 inputs" in picture


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
    with served_here(robot, pty=True) as (port, probe):
        run = subprocess.Popen(
            [sys.executable, "-m", "bilprov", "lab", "learn", port, "--probe", probe, "--yes"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
        )
        with run:
            until = time.monotonic() + PATIENCE
            while robot.frames < 1200 and time.monotonic() < until:  # past the opening
                time.sleep(0.05)
            while not robot.state.moving and time.monotonic() < until:
                time.sleep(0.001)
            run.send_signal(signal.SIGINT)
            out, err = run.communicate(timeout=PATIENCE)

    assert run.returncode == 3, err
    assert out.decode().splitlines()[-1] == "it was not learned to the end: interrupted"
    assert b"Traceback" not in err
    assert at_rest(robot)
