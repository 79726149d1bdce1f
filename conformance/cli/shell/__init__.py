"""`bilprov send PORT`: a device is sent items of the command line, typed ones, or lines of a pipe.

It stands here, and not in the analyzer, because a probe may look at the robot.
"""
