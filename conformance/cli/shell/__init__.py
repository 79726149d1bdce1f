"""`bilprov shell`: a robot is driven by hand, with typed instructions or lines from a pipe.

It stands here, and not beside `send`, because a probe may look at the robot.
"""
