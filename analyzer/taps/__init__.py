"""Taps, which never write to a line; a bridge, which changes no byte; a line made unreliable."""
