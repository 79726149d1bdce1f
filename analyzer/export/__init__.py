"""Writes the decoded traffic of a capture in the formats of other programs, one module for each."""
