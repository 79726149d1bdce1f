"""Captures: MCAP files of the traffic on a line, with times. Uses no ports and no test cases."""
