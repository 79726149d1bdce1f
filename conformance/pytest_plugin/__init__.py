"""A pytest plugin: `--robot-port PORT` makes each case a test, and gives tests a fixture `robot`.

    pytest --robot-port /dev/ttyUSB0 --robot-probe tcp:robot.local:9000 --robot-yes
    pytest --robot-port sim conformance -k bad-data
    pytest --robot-port sim 'conformance::valid/Stop' test_mine.py

The cases are collected where no file is named, and where `conformance` is. They are judged in one
run, in its order. A user's own test takes the fixture:

    def test_it_stops(robot):
        robot.speed(80)  # raises where the answer is not OK
        robot.forward()
        assert robot.send("Stop").name == "OK"
        assert not robot.look().moving

Without `--robot-port` the rest of the kit is not imported, so the plugin costs no time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from bilprov.conformance.pytest_plugin.session import Client

_SESSION = "bilprov-robot"
MARKER = "conformance: one case of the robot's conformance suite (bilprov)"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the plugin's options, all of them `--robot-...`."""
    group = parser.getgroup("robot", "conformance of a robot (bilprov)")
    add = group.addoption
    add("--robot-port", metavar="PORT|sim", help="Test the robot there: a path, a pyserial URL, "
        "sim, the simulator in virtual time, or emulator:KIND:FIRMWARE, as conform takes it. "
        "One test per case, each in a run of its own")  # fmt: skip
    add("--robot-probe", metavar="PROBE", help="What sees a stop: tcp:HOST:PORT, exec:COMMAND, "
        "modem:LINE or none; sim and emulators bring their own")  # fmt: skip
    add("--robot-only", metavar="GLOB", action="append", help="Only these cases; * crosses /")
    add("--robot-level", metavar="LEVEL", help="How much: smoke, standard (unless given) or deep")
    add("--robot-allow", metavar="NAME=VALUE", action="append", help="Accept a choice that fails "
        "otherwise, as conform --allow does")  # fmt: skip
    add("--robot-seed", metavar="N", type=int, help="Seed for the choice of data and motions (1)")
    add("--robot-baud", metavar="N", type=int, help="Bits/s, the grammar's own unless given")
    add("--robot-grammar", metavar="FILE.py", help="Another grammar of the same family")
    add("--robot-fault", metavar="NAME", help="With sim: misbehave in this way")
    add("--robot-yes", action="store_true", help="The robot may move: do not ask")


def pytest_configure(config: pytest.Config) -> None:
    """Register a RobotSession if --robot-port is given. Raises UsageError for wrong use."""
    config.addinivalue_line("markers", MARKER)
    if config.getoption("robot_port") is None:
        options = vars(config.option).items()
        if given := [name for name, value in options if name.startswith("robot_") and value]:
            option = given[0].replace("_", "-")
            raise pytest.UsageError(f"--{option} needs --robot-port PORT, or sim")
        return
    from bilprov.conformance.pytest_plugin.session import RobotSession

    config.pluginmanager.register(RobotSession(config), _SESSION)


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> Iterator[Client]:
    """The robot at --robot-port, as a `session.Client`: homed before and after the test.

    Skips the test where there is no --robot-port.
    """
    session = request.config.pluginmanager.get_plugin(_SESSION)
    if session is None:
        pytest.skip("the fixture robot needs --robot-port PORT, or sim")
    with session.bench.client() as client:
        yield client
