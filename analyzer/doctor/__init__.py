"""Examines a port: what keeps it from being used, and the one command that mends each."""
