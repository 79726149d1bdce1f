"""A robot driven from Python."""
