"""The robot's instructions as methods, for type checkers and editors.

Generated from the grammar (robot-car 1.1), not edited by hand. To renew it:
`bilprov spec emit stub -o analyzer/client/robot.pyi`.
"""

from bilprov.analyzer.client.driver import Answer, Driver
from bilprov.analyzer.client.port_driver import PortDriver

class Instructions(Driver):
    """The instructions of robot-car 1.1; `Driver` documents what each of them raises."""

    def stop(self) -> Answer:
        """Stops the robot and resets the directions that were set."""

    def speed(self, speed: int) -> Answer:
        """Sets the speed with which the robot moves; used together with the other instructions.

        speed: 0 to 255, speed that the other instructions use
        """

    def forward(self) -> Answer:
        """Sets the direction forward and drives at the speed set before."""

    def backward(self) -> Answer:
        """Sets the direction backward and drives at the speed set before."""

    def right(self, strength: int) -> Answer:
        """Moves right at the speed and in the direction set before.

        strength: 0 to 255, steering strength
        """

    def left(self, strength: int) -> Answer:
        """Moves left at the speed and in the direction set before.

        strength: 0 to 255, steering strength
        """

    def rotate_right(self) -> Answer:
        """Stops, then rotates on the spot to the right at the speed set before."""

    def rotate_left(self) -> Answer:
        """Stops, then rotates on the spot to the left at the speed set before."""

    def led(self, rgb: int) -> Answer:
        """Changes the colours of the RGB diode: the last three bits switch R, G and B.

        rgb: 0 to 7, colours, 1 on and 0 off
        """

class Robot(Instructions, PortDriver):
    """A robot on a port, to be driven from Python."""
