"""Drives a robot from Python: each instruction of the grammar is a method. Stops it at the end."""
