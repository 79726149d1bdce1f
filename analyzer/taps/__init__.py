"""Passive taps on a line, a bridge between host and device, and an impaired line."""
