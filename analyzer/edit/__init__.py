"""Edits and compares captures: a part of one, several put together, two held against each other."""
