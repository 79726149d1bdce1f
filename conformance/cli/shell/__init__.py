"""`bilprov send PORT`: a robot is driven by hand, with typed instructions or lines from a pipe.

It stands here, and not in the analyzer, because a probe may look at the robot.
"""
