"""The class Robot of `from bilprov import Robot`; the types of its methods are in robot.pyi."""

from __future__ import annotations

from bilprov.analyzer.client.driver import Driver
from bilprov.analyzer.client.port_driver import PortDriver


class Instructions(Driver):
    """A driver whose methods type checkers know, for the kit's own grammar (see robot.pyi)."""


class Robot(Instructions, PortDriver):
    """A robot on a port, driven from Python; each instruction of the grammar is a method.

        with Robot("/dev/ttyUSB0") as robot:
            robot.speed(127)
            robot.forward()
            time.sleep(1)

    Opening it starts no motion and asks for no confirmation. Leaving the block stops the robot,
    also after an exception. `PortDriver` and `Driver` describe the arguments and the exceptions.
    """
