"""Captures: MCAP files of the bytes on a line, with times. Opens no port and knows no test case."""
