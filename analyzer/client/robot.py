"""`from bilprov import Robot`: the instructions as methods. The types stand in robot.pyi."""

from __future__ import annotations

from analyzer.client.driver import Driver
from analyzer.client.port_driver import PortDriver


class Instructions(Driver):
    """A robot whose instructions are methods; type checkers know those of the kit's own grammar."""


class Robot(Instructions, PortDriver):
    """A robot on a port, driven from Python; each instruction of the grammar is a method.

        with Robot("/dev/ttyUSB0") as robot:
            robot.speed(127)
            robot.forward()
            time.sleep(1)

    Opening it moves nothing and asks nobody: a program is its own consent. Leaving the block stops
    the robot, whatever the way out. What it takes and raises stands at `PortDriver` and `Driver`.
    """
